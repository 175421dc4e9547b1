"""Scores of parts that were found: how they moved, and how they and their joints compare to the truth."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int

from gsjax.engine.messages import Notes
from gsjax.engine.recording import Recording
from gsjax.engine.scores import motion_metrics
from gsjax.geometry.joints import FittedJoint
from gsjax.methods.parts import BACKGROUND, PartScene, Trajectory, gaussians_at, moment, motions_in_world
from gsjax.metrics.parts import adjusted_rand_index, joint_error, match_parts
from gsjax.metrics.tracking import relative_motion, score_tracks, true_labels
from gsjax.scene.handles import Blend

_NAMED_IOU = 0.25  # overlap with a true part below which a found one does not bear its name
_AROUND = 0.05 * np.concatenate([np.eye(3), -np.eye(3)])  # metres about an object of which nothing is drawn
_STILL_MM = 2.0  # a true part that moves less cannot be found by its motion, and counts as background


def part_rows(
    scene: PartScene, trajectory: Trajectory, joints: dict[int, FittedJoint]
) -> list[dict[str, Any]]:
    """A row for each part without what takes truth, by the keys of `PART_COLUMNS`.

    Args:
        scene: the parts.
        trajectory: where they went.
        joints: the joint that explains each part's motion, by part.
    """
    motions, labels = motions_in_world(scene, trajectory), np.asarray(scene.labels)
    means = np.asarray(scene.gaussians.means, np.float64)
    rows = []
    for part, fitted in joints.items():
        mine = means[labels == part]
        opens = None if fitted.joint is None else float(np.ptp(fitted.joint.values))
        turns = fitted.kind == "revolute"
        rows.append(
            {
                "part": part,
                "name": f"part {part}",
                "gaussians": len(mine),
                "moved_mm": _farthest_mm(motions[:, part], mine),
                "kind": fitted.kind,
                "range": None if opens is None else (np.degrees(opens) if turns else 1000 * opens),
                "axis": None if fitted.joint is None else fitted.joint.axis.tolist(),
                "point": None if fitted.joint is None else fitted.joint.point.tolist(),
                "confidence": 100 * fitted.confidence,
            }
        )
    return rows


def score_parts(
    scene: PartScene,
    trajectory: Trajectory,
    joints: dict[int, FittedJoint],
    rows: list[dict[str, Any]],
    recording: Recording,
    anchor: int,
    blend: Blend,
    notes: Notes,
) -> dict[str, Any]:
    """Scores of the whole, and in each row those of the part; nothing where the recording has no truth.

    Args:
        scene, trajectory: the parts, and where they went.
        joints: the joint that explains each part's motion, by part.
        rows: of `part_rows`; each gets the scores of its part.
        recording: with the truth.
        anchor: the canonical frame.
        blend: how turns of several parts are blended.
        notes: receive what was not scored.

    Returns:
        `ari` (over the Gaussians whose true label is known), `true_parts` (those that move), `missed` (the
        names of those that no part overlaps with by a quarter).
    """
    sequence = recording.tracked
    truth = sequence.truth
    if truth is None or not truth.names:
        return {}
    if not (sequence.has_masks and sequence.has_depth):
        notes.add("Parts were not scored: which Gaussian is of which true part takes masks and depth.")
        return {}
    labels = _true_labels(scene, recording, anchor)
    poses = {int(label): truth.poses[:, k] for k, label in enumerate(truth.label_ids)}
    scores = score_tracks(_tracks(scene, trajectory, blend), labels, poses, anchor)
    means = np.asarray(scene.gaussians.means, np.float64)
    # By where the object truly is: one that no Gaussian shows moves all the same, and is missed.
    ways = {k: relative_motion(pose, anchor) for k, pose in poses.items()}
    around = {k: pose[anchor, :3, 3] + _AROUND for k, pose in poses.items()}
    far = {k: _farthest_mm(ways[k], means[labels == k] if k in labels else around[k]) for k in poses}
    moving = [label for label in poses if far[label] > _STILL_MM]
    still = [truth.names[list(poses).index(label)] for label in poses if label not in moving]
    if still:
        notes.add(f"Counted as background, for it does not move: {', '.join(still)}.")
    known = np.where(np.isin(labels, [-1, *moving]), labels, BACKGROUND)
    found = np.asarray(scene.labels)
    match = match_parts(found, known)
    names = dict(zip(poses, truth.names, strict=True))
    joint_of = dict(zip(poses, truth.joints or [None] * len(poses), strict=True))
    pairs = {
        label: part
        for label, part in match.found.items()
        if BACKGROUND not in (label, part) and match.ious[label] >= _NAMED_IOU
    }
    for label, part in pairs.items():
        row = rows[part - 1]
        row |= {"true_name": names[label], "iou": match.ious[label], **motion_metrics(scores[label])}
        row["moved_mm"] = scores[label].moved_mm
        joint, fitted = joint_of[label], joints[part]
        if joint is not None and fitted.joint is not None:
            middle = means[found == part].mean(0)
            row |= joint_error(fitted.joint, joint, middle, anchor)._asdict()
            row["value"] = row["value_deg"] if joint.kind == "revolute" else row["value_mm"]
    missed = [names[label] for label in moving if label not in pairs]
    if missed:
        notes.warn(f"of what truly moves, no part that was found is {', '.join(missed)}")
    return {
        "ari": adjusted_rand_index(found, known),
        "true_parts": len(moving),
        "missed": missed,
    }


def _true_labels(scene: PartScene, recording: Recording, anchor: int) -> Int[np.ndarray, "N"]:
    sequence = recording.tracked
    seen = [(sequence.mask(anchor, c), sequence.depth(anchor, c), c) for c in range(sequence.num_cameras)]
    masks, depths, cameras = zip(
        *(one for one in seen if one[0] is not None and one[1] is not None), strict=True
    )
    views = [sequence.viewmats[anchor, c] for c in cameras], [sequence.Ks[anchor, c] for c in cameras]
    return true_labels(np.asarray(scene.gaussians.means), masks, depths, *views)


def _tracks(scene: PartScene, trajectory: Trajectory, blend: Blend) -> Float[np.ndarray, "T N 3"]:
    """Where all Gaussians are at all times."""
    means = jax.jit(lambda now: gaussians_at(scene, now, blend).means)
    return np.stack([means(moment(trajectory, t)) for t in range(len(trajectory.times))])


def _farthest_mm(motions: Float[np.ndarray, "T 4 4"], points: Float[np.ndarray, "n 3"]) -> float:
    """How far motions take points at most, on average over these; 0 without points."""
    if not len(points):
        return 0.0
    moved = np.einsum("tij,nj->tni", motions[:, :3, :3], points) + motions[:, None, :3, 3]
    return 1000 * float(np.linalg.norm(moved - points, axis=-1).mean(-1).max())
