"""What a run that may be killed leaves from time to time, so that another can go on from it."""

import warnings
from collections.abc import Callable
from time import perf_counter

from gsjax.data.errors import DataWarning
from gsjax.engine.messages import describe

EVERY_S = 30.0
"""Seconds of work that a run may lose when it is killed."""


class Saver:
    """Saves again and again, neither too often nor too seldom.

    Args:
        goes_on: what does, where nothing can be written: "following".
        every: seconds of work that a run may lose when it is killed; `EVERY_S` unless given.
    """

    def __init__(self, goes_on: str, every: float | None = None):
        self._goes_on, self._every, self._at = goes_on, every, perf_counter()

    def __call__(self, write: Callable[[], None], *, last: bool) -> None:
        """Write if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        every = EVERY_S if self._every is None else self._every
        if not last and perf_counter() - self._at < every:
            return
        try:
            write()
        except OSError as error:
            message = f"could not save what --resume needs ({describe(error)}); {self._goes_on} goes on"
            warnings.warn(message, DataWarning, stacklevel=2)
        self._at = perf_counter()
