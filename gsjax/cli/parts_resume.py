"""What an unfinished `gsjax parts` leaves from time to time, so that another can go on from it."""

import warnings
from pathlib import Path
from time import perf_counter

import jax

from gsjax.cli.messages import describe
from gsjax.cli.parts_loop import Following
from gsjax.data.errors import DataWarning
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint

EVERY_S = 30.0
"""Seconds of following that a run may lose when it is killed."""
_STATE = "parts.npz"


class Saver:
    """Writes the state of a run into its folder `resume/`."""

    def __init__(self, folder: Path):
        self._path, self._at = folder / _STATE, perf_counter()

    def __call__(self, following: Following, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        if not last and perf_counter() - self._at < EVERY_S:
            return
        metadata = {
            "update_s": following.update_s,
            "losses": following.losses,
            "skipped": following.skipped,
            "joined": following.joined,
            "divided": following.divided,
        }
        try:
            save_checkpoint(self._path, jax.device_get(following.parts), metadata)
        except OSError as error:
            message = f"could not save what --resume needs ({describe(error)}); following goes on"
            warnings.warn(message, DataWarning, stacklevel=2)
        self._at = perf_counter()


def load(folder: Path, first: Following) -> Following:
    """What a run had come to; `first` where it was stopped before it had saved anything.

    Raises:
        CheckpointError: it is damaged, or of another scene.
    """
    path = folder / _STATE
    if not path.is_file():
        return first
    parts, _ = load_checkpoint(path, first.parts)
    found = load_metadata(path)
    losses, joined, divided = ([tuple(pair) for pair in found[k]] for k in ("losses", "joined", "divided"))
    return Following(parts, found["update_s"], losses, found["skipped"], joined, divided)
