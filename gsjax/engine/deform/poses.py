"""Poses that `gsjax deform` refined: the recording as it was found to be seen, and how far that is off."""

from dataclasses import replace
from typing import Any

import numpy as np

from gsjax.engine.deform.data import DeformData
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes
from gsjax.io.atomic import write_npz
from gsjax.methods.deform import DeformingScene, Problem, refined_viewmats, times_of

NAME = "poses.npz"
"""View matrices that were found, of all frames and cameras, in the folder of a run."""


def as_refined(
    folder: RunFolder, problem: Problem, scene: DeformingScene, data: DeformData, notes: Notes
) -> tuple[DeformData, dict[str, Any] | None]:
    """The data with poses as they were found, which are also written, and the part of metrics.json on them;
    the data themselves and None where poses stand as given."""
    if scene.twists is None:
        return data, None
    given = data.sequence.viewmats
    learned = times_of(problem.frames)
    found = refined_viewmats(given, data.times, scene.twists, learned, problem.radius)
    sequence = replace(data.sequence, viewmats=found)
    arrays = {"viewmats": found, "frame_ids": sequence.frame_ids, "camera_ids": sequence.camera_ids}
    write_npz(folder.path / NAME, arrays)
    notes.add(
        f"Poses were refined ({NAME}), and are judged so: a held-out frame's by what its neighbours in time "
        "were found to be off by, without a look at its picture."
    )
    turned, moved = _apart(given[:, 0], found[:, 0])
    return replace(data, sequence=sequence), {
        "turned_deg": {"median": float(np.median(turned)), "max": float(turned.max())},
        "moved": {"median": float(np.median(moved)), "max": float(moved.max())},
    }


def _apart(given: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Degrees between view matrices, and how far apart their cameras are in the unit of the poses."""
    between = found[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2)
    turned = np.rad2deg(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    centers = [-np.einsum("tji,tj->ti", v[:, :3, :3], v[:, :3, 3]) for v in (given, found)]
    return turned, np.linalg.norm(centers[1] - centers[0], axis=1)
