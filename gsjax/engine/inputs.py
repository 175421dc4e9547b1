"""Digests of what a run was given, by which --resume notices that it has changed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gsjax.data import Sequence
from gsjax.data.photographs import Photographs
from gsjax.engine.teaching.cache import content_digest
from gsjax.scene.frame import Frame

Inputs = Mapping[str, str | None]
"""Digests of a run's inputs, by their descriptions."""
_SAMPLES = 2**16  # of an array; to read gigabytes of pictures again would take seconds


def photographs_digest(photographs: Photographs, fitted: np.ndarray, frames: list[Frame]) -> str:
    """A digest of photographs, of pixels at regular distances.

    Args:
        photographs: the photographs.
        fitted: [N], indices of those that are fitted.
        frames: all of them, in memory.
    """
    return _digest(photographs.names, fitted, frames)


def recording_digest(sequence: Sequence, first: Frame) -> str:
    """A digest of a recording: its times, its cameras, and pixels of its first frame at regular distances.

    Args:
        sequence: the recording.
        first: its first frame.
    """
    return _digest(sequence.frame_ids, sequence.times, sequence.Ks, sequence.viewmats, first)


def expect_same(stored: Inputs, given: Inputs, run: Path) -> None:
    """Raises ValueError if a run's inputs have changed. Those of which the version that began it stored no
    digest are ignored.

    Args:
        stored: those that it was started with.
        given: the present ones.
        run: its folder.
    """
    others = [what for what, digest in stored.items() if given.get(what) != digest]
    if others:
        raise ValueError(
            f"--resume: {' and '.join(others)}: expected the same as when the run in {run} was started, "
            "found a change; undo it, or replace the run with --overwrite instead"
        )


def _digest(*data: Any) -> str:
    leaves = [np.asarray(leaf).ravel() for leaf in jax.tree.leaves(data)]
    samples = {str(i): leaf[:: 1 + leaf.size // _SAMPLES] for i, leaf in enumerate(leaves)}
    return content_digest("inputs", samples)
