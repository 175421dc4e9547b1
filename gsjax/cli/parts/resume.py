"""What an unfinished `gsjax parts` leaves from time to time, so that another can go on from it."""

from pathlib import Path

from gsjax.cli.parts.loop import Following
from gsjax.cli.run import saving
from gsjax.io.checkpoints import load_checkpoint, load_metadata

_STATE = "parts.npz"


class Saver:
    """Writes the state of a run into its folder `resume/`."""

    def __init__(self, folder: Path):
        self._save = saving.Saver(folder / _STATE, "following")

    def __call__(self, following: Following, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        self._save(
            following.parts,
            lambda: {
                "update_s": following.update_s,
                "losses": following.losses,
                "skipped": following.skipped,
                "joined": following.joined,
                "divided": following.divided,
            },
            last=last,
        )


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
