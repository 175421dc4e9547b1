"""Saving the state of a run from time to time, so that it can be resumed if it is killed."""

import warnings
from collections.abc import Callable
from time import perf_counter

from gsjax.data.errors import DataWarning
from gsjax.engine.messages import describe

EVERY_S = 30.0
"""Seconds of work that a run may lose when it is killed."""


class Saver:
    """Saves at most once every few seconds.

    Args:
        work: the work that goes on if nothing can be written: "tracking".
        every: seconds of work that a run may lose when it is killed (default: `EVERY_S`).
    """

    def __init__(self, work: str, every: float | None = None):
        self._work, self._every, self._at = work, every, perf_counter()

    def __call__(self, write: Callable[[], None], *, last: bool) -> None:
        """Write if the previous save is long enough ago or this is the last one; warn if writing fails."""
        every = EVERY_S if self._every is None else self._every
        if not last and perf_counter() - self._at < every:
            return
        try:
            write()
        except OSError as error:
            message = f"could not save what --resume needs ({describe(error)}); {self._work} goes on"
            warnings.warn(message, DataWarning, stacklevel=2)
        self._at = perf_counter()
