"""What an unfinished `gsjax parts` leaves from time to time, so that another can go on from it."""

from pathlib import Path

import jax

from gsjax.engine import saving
from gsjax.engine.parts.loop import Following
from gsjax.io.checkpoints import load_checkpoint, load_metadata, save_checkpoint

_STATE = "parts.npz"
_KEPT = ("update_s", "losses", "skipped", "joined", "divided")


class Saver:
    """Writes the state of a run into its folder `resume/`."""

    def __init__(self, folder: Path):
        self._path, self._save = folder / _STATE, saving.Saver("following")

    def __call__(self, following: Following, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        self._save(lambda: self._write(following), last=last)

    def _write(self, following: Following) -> None:
        metadata = {name: getattr(following, name) for name in _KEPT}
        save_checkpoint(self._path, jax.device_get(following.parts), metadata)


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
