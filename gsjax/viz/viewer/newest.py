"""Work that is asked for more often than it can be done: only the newest wish counts."""

import threading
from collections.abc import Callable
from time import monotonic


class Newest:
    """A thread that works when asked, once for all that was asked meanwhile.

    Work begins when nobody has asked for `settle_s`, or `patience_s` after the first wish, so that what moves
    all the time is seen now and then. It looks up for itself what is wanted, and so does what is newest.

    Args:
        work: what to do; it must not raise.
        settle_s: seconds.
        patience_s: seconds.
        hold: only note what is asked for, until told to `begin`.
    """

    def __init__(
        self,
        work: Callable[[], None],
        settle_s: float = 0.0,
        patience_s: float = 0.0,
        hold: bool = False,
    ):
        self._work, self._settle_s, self._patience_s = work, settle_s, patience_s
        self._changed = threading.Condition()
        self._asked = self._closed = False
        self._thread = threading.Thread(target=self._run, name="gsjax viewer", daemon=True)
        if not hold:
            self.begin()

    def begin(self) -> None:
        """Work from now on, also at what was asked for before. Once."""
        self._thread.start()

    def ask(self) -> None:
        """Have it done, soon."""
        with self._changed:
            self._asked = True
            self._changed.notify()

    def close(self) -> None:
        """Begin nothing any more; does not wait for what was begun."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while self._wait():
            self._work()

    def _wait(self) -> bool:
        """Until there is something to do (True), or it is closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._asked or self._closed)
            until = monotonic() + self._patience_s
            while self._asked and not self._closed:
                self._asked = False
                self._changed.wait(max(0.0, min(self._settle_s, until - monotonic())))
                if monotonic() >= until:
                    break
            self._asked = False
            return not self._closed
