"""Work that is requested more often than it can be done: requests are merged."""

import threading
from collections.abc import Callable
from time import monotonic


class Debouncer:
    """A thread that works on request, once for all requests that arrive meanwhile.

    Work starts when no request has arrived for `settle_s`, or `patience_s` after the first one, so that
    continuous motion is still updated now and then. `work` reads the latest state itself.

    Args:
        work: what to do; it must not raise.
        settle_s: seconds without a request before work starts.
        patience_s: seconds after the first request at which work starts regardless.
        hold: only record requests until `start` is called.
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
        self._requested = self._closed = False
        self._thread = threading.Thread(target=self._run, name="gsjax viewer", daemon=True)
        if not hold:
            self.start()

    def start(self) -> None:
        """Start working, including on earlier requests. Call it once."""
        self._thread.start()

    def request(self) -> None:
        """Request that the work be done soon."""
        with self._changed:
            self._requested = True
            self._changed.notify()

    def close(self) -> None:
        """Start no more work; does not wait for work in progress."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def _run(self) -> None:
        while self._wait():
            self._work()

    def _wait(self) -> bool:
        """Wait until there is something to do (True) or the worker is closed (False)."""
        with self._changed:
            self._changed.wait_for(lambda: self._requested or self._closed)
            until = monotonic() + self._patience_s
            while self._requested and not self._closed:
                self._requested = False
                self._changed.wait(max(0.0, min(self._settle_s, until - monotonic())))
                if monotonic() >= until:
                    break
            self._requested = False
            return not self._closed
