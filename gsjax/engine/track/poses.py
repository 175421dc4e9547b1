"""Scores of the poses of tracked objects, as in benchmarks of pose estimation; docs/scores.md has the
definitions."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from gsjax.data import Sequence
from gsjax.data.objects import ObjectModel
from gsjax.engine.track.loop import Tracking
from gsjax.metrics.pose import (
    MSPD_PIXELS,
    MSPD_WIDTH,
    MSSD_SHARES,
    average_recall,
    diameter,
    fitted_poses,
    mspd,
    mssd,
    score_poses,
)
from gsjax.metrics.segmentation import IGNORED_LABEL

OWN_POINTS = "Gaussians of the first frame"
"""Source of the model of an object for which the recording has none."""


def pose_metrics(
    tracking: Tracking,
    sequence: Sequence,
    group_labels: Int[np.ndarray, "groups"],
    true_labels: Int[np.ndarray, "N"] | None,
) -> dict[int, dict[str, Any]]:
    """The scores of each object's poses for metrics.json, by label; without those that are not tracked or
    have no points.

    An object's pose is its true one in the first frame, moved as its Gaussians move. The model is the
    recording's, or else those Gaussians in the first frame, except those known to belong to something else.

    Args:
        tracking: the scene and its poses.
        sequence: the tracked cameras, with the truth.
        group_labels: the label of each group of the scene, the background first.
        true_labels: of each Gaussian, -1 where unknown; None if that is unknown of all.
    """
    truth, scored = sequence.truth, {}
    if truth is None or tracking.num_frames < 2:
        return scored
    labels, means = group_labels[np.asarray(tracking.scene.labels)], tracking.means().astype(np.float64)
    for k, label in enumerate(truth.label_ids.tolist()):
        members, true = labels == label, truth.poses[: tracking.num_frames, k]
        if not members.any():
            continue
        known = truth.models[k] if truth.models else None
        if known is None:
            own = members if true_labels is None else members & np.isin(true_labels, [label, IGNORED_LABEL])
            if not own.any():
                continue
            points = (means[0, own] - true[0, :3, 3]) @ true[0, :3, :3]
            source, length = OWN_POINTS, diameter(points)
        else:
            source, points, length = known.source, known.points, known.diameter
        estimated = fitted_poses(means[:, members], true[0])
        scored[label] = {
            "model": source,
            "points": len(points),
            "diameter_mm": 1000 * length,
            **score_poses(estimated, true, points, length)._asdict(),
            **_bop_recalls(estimated, true, known, sequence),
        }
    return scored


def _bop_recalls(
    estimated: Float[np.ndarray, "T 4 4"],
    true: Float[np.ndarray, "T 4 4"],
    model: ObjectModel | None,
    sequence: Sequence,
) -> dict[str, float | None]:
    """BOP's average recalls, over all frames and cameras; None where the symmetries are unknown."""
    if model is None:
        return {"mssd_recall": None, "mspd_recall": None}
    surface = mssd(estimated, true, model.points, model.symmetries)
    projected = np.concatenate(
        [
            mspd(
                estimated,
                true,
                model.points,
                model.symmetries,
                sequence.viewmats[: len(true), c],
                sequence.Ks[: len(true), c],
            )
            for c in range(sequence.num_cameras)
        ]
    )
    return {
        "mssd_recall": average_recall(surface, MSSD_SHARES * model.diameter),
        "mspd_recall": average_recall(projected, MSPD_PIXELS * sequence.width / MSPD_WIDTH),
    }
