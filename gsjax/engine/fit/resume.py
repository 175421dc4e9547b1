"""What an unfinished fit leaves from time to time, so that another can go on from it to the same bits."""

from pathlib import Path

import jax
import numpy as np

from gsjax.engine import saving
from gsjax.engine.fit.results import Curve
from gsjax.engine.folder import RunFolder
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.fit import FitState, Problem
from gsjax.methods.fit.method import enlarged

KEPT = 2
"""Checkpoints that are kept: one that is damaged leaves the one before."""


class Saver:
    """Writes the state of a fit into RUN/resume.

    Args:
        folder: of the run.
        every: seconds of fitting that a run may lose when it is killed.
    """

    def __init__(self, folder: RunFolder, every: float):
        self._folder, self._save = folder.resume, saving.Saver("the fit", every)

    def __call__(self, state: FitState, curve: Curve, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        self._save(lambda: self._write(state, curve), last=last)

    def _write(self, state: FitState, curve: Curve) -> None:
        metadata = {
            "degree": state.gaussians.sh_degree,
            "slots": state.gaussians.num,
            "sizes": len(state.capacity),
            "step": state.step,
            "curve": curve.metadata(),
        }
        save_checkpoint(_path(self._folder, state.step), jax.device_get(state), metadata)
        for old in _saved(self._folder)[:-KEPT]:
            old.unlink()


def load(folder: Path, problem: Problem, start: FitState) -> tuple[FitState, Curve]:
    """The newest state that is whole, and the curve until then; the start where a run was stopped before it
    had saved any.

    Args:
        folder: RUN/resume.
        problem: what is fitted to what.
        start: the state before the first step.

    Raises:
        CheckpointError: there are only damaged ones.
    """
    wrong, damaged = None, []
    for path in reversed(_saved(folder)):
        try:
            metadata = load_metadata(path)
            size = metadata["degree"], metadata["slots"]
            model, optimizer = enlarged(problem, start.model, start.optimizer, *size)
            like = FitState(model, optimizer, 0, np.zeros((metadata["sizes"], 4), int))
            state, _ = load_checkpoint(path, like)
            for later in damaged:  # else they would count among the newest
                later.unlink()
            return state, Curve.of(metadata["curve"])
        except CheckpointError as error:
            wrong = error
            damaged.append(path)
    if wrong is not None:
        raise wrong
    return start, Curve()


def _path(folder: Path, step: int) -> Path:
    return folder / f"step-{step:08d}.npz"


def _saved(folder: Path) -> list[Path]:
    """Checkpoints in the order in which they were made."""
    return sorted(folder.glob("step-*.npz"))
