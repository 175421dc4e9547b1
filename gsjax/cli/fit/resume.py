"""What an unfinished fit leaves from time to time, so that another can go on from it to the same bits."""

import warnings
from pathlib import Path
from time import perf_counter

import jax
import numpy as np

from gsjax.cli.fit.results import Curve
from gsjax.cli.messages import describe
from gsjax.cli.run.folder import RunFolder
from gsjax.data.errors import DataWarning
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.reconstruction import FitState, Problem
from gsjax.methods.reconstruction.fit import enlarged

KEPT = 2
"""Checkpoints that are kept: one that is damaged leaves the one before."""


class Saver:
    """Writes the state of a fit into RUN/resume.

    Args:
        folder: of the run.
        every: seconds of fitting that a run may lose when it is killed.
    """

    def __init__(self, folder: RunFolder, every: float):
        self._folder, self._every, self._at = folder.resume, every, perf_counter()

    def __call__(self, state: FitState, curve: Curve, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        if not last and perf_counter() - self._at < self._every:
            return
        metadata = {
            "degree": state.gaussians.sh_degree,
            "slots": state.gaussians.num,
            "sizes": len(state.capacity),
            "step": state.step,
            "curve": curve.metadata(),
        }
        try:
            save_checkpoint(_path(self._folder, state.step), jax.device_get(state), metadata)
            for old in _saved(self._folder)[:-KEPT]:
                old.unlink()
        except OSError as error:
            message = f"could not save what --resume needs ({describe(error)}); the fit goes on"
            warnings.warn(message, DataWarning, stacklevel=2)
        self._at = perf_counter()


def load(folder: Path, problem: Problem, start: FitState) -> tuple[FitState, Curve]:
    """The newest state that is whole, and the curve until then; the start where a run was stopped before it
    had saved any.

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
