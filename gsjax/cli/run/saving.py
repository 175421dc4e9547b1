"""What a run that may be killed leaves from time to time, so that another can go on from it."""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import jax

from gsjax.cli.messages import describe
from gsjax.data.errors import DataWarning
from gsjax.io.checkpoints import save_checkpoint

EVERY_S = 30.0
"""Seconds of work that a run may lose when it is killed."""


class Saver:
    """Writes one checkpoint, again and again.

    Args:
        path: of the file.
        goes_on: what does, where it cannot be written: "following".
    """

    def __init__(self, path: Path, goes_on: str):
        self._path, self._goes_on, self._at = path, goes_on, perf_counter()

    def __call__(self, tree: Any, metadata: Callable[[], Mapping[str, Any]], *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        if not last and perf_counter() - self._at < EVERY_S:
            return
        try:
            save_checkpoint(self._path, jax.device_get(tree), metadata())
        except OSError as error:
            message = f"could not save what --resume needs ({describe(error)}); {self._goes_on} goes on"
            warnings.warn(message, DataWarning, stacklevel=2)
        self._at = perf_counter()
