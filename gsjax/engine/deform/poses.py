"""Camera poses refined by `gsjax deform`: the recording with them, and how far they are from those given."""

from dataclasses import replace
from typing import Any

import numpy as np

from gsjax.engine.deform.data import DeformData
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes
from gsjax.io.atomic import write_npz
from gsjax.methods.deform import DeformingScene, Problem, refined_viewmats, times_of
from gsjax.scene.origin import cameras_in_world

NAME = "poses.npz"
"""Refined view matrices of all frames and cameras, in the folder of a run."""


def with_refined_poses(
    folder: RunFolder, problem: Problem, scene: DeformingScene, data: DeformData, notes: Notes
) -> tuple[DeformData, dict[str, Any] | None]:
    """Returns the data with refined poses, which are also written, and the entry of metrics.json about them;
    the unchanged data and None if poses were not refined.

    Args:
        folder: of the run.
        problem: the problem that was solved.
        scene: the result.
        data: the recording, with the poses as given.
        notes: receives how frames are judged.
    """
    if scene.twists is None:
        return data, None
    given = data.sequence.viewmats
    learned = times_of(problem.frames)
    found = refined_viewmats(given, data.times, scene.twists, learned, problem.radius)
    sequence = replace(data.sequence, viewmats=found)
    arrays = {"viewmats": cameras_in_world(found, sequence.origin)}
    arrays |= {"frame_ids": sequence.frame_ids, "camera_ids": sequence.camera_ids}
    write_npz(folder.path / NAME, arrays)
    notes.add(
        f"Poses were refined ({NAME}), and frames are judged with the refined poses. The pose of a held-out "
        "frame is corrected like those of its neighbours in time; its picture is not used."
    )
    turned, moved = _apart(given[:, 0], found[:, 0])
    return replace(data, sequence=sequence), {
        "turned_deg": {"median": float(np.median(turned)), "max": float(turned.max())},
        "moved": {"median": float(np.median(moved)), "max": float(moved.max())},
    }


def _apart(given: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles between view matrices, degrees, and distances of their cameras, in the unit of the poses."""
    between = found[:, :3, :3] @ np.swapaxes(given[:, :3, :3], 1, 2)
    turned = np.rad2deg(np.arccos(np.clip((np.trace(between, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    centers = [-np.einsum("tji,tj->ti", v[:, :3, :3], v[:, :3, 3]) for v in (given, found)]
    return turned, np.linalg.norm(centers[1] - centers[0], axis=1)
