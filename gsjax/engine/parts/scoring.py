"""Scores of the parts found: how they moved, and how they and their joints compare with ground truth."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from gsjax.data.objects import Truth
from gsjax.engine.messages import Notes
from gsjax.engine.recording import Recording
from gsjax.engine.scores import motion_metrics, true_labels_at
from gsjax.geometry.joints import FittedJoint, Joint
from gsjax.methods.parts import BACKGROUND, PartScene, Trajectory, gaussians_at, moment, motions_in_world
from gsjax.metrics.parts import adjusted_rand_index, joint_error, match_parts
from gsjax.metrics.tracking import relative_motion, score_tracks
from gsjax.scene.handles import Blend

_NAMED_IOU = 0.25  # smallest overlap with a true part for a part to get its name
_QUANTILES = (0.02, 0.98)  # quantiles that bound a scene
_AROUND = 0.05 * np.concatenate([np.eye(3), -np.eye(3)])  # metres, around an object without Gaussians
_STILL_MM = 2.0  # a true part that moves less cannot be found by its motion, and counts as background


def part_rows(
    scene: PartScene, trajectory: Trajectory, joints: dict[int, FittedJoint]
) -> list[dict[str, Any]]:
    """A row for each part, with what is known without ground truth.

    Args:
        scene: the parts.
        trajectory: their motion.
        joints: the joint fitted to each part's motion, by part.
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
                "moved_mm": float(_moved_mm(motions[:, part], mine).max()),
                "kind": fitted.kind,
                "range": None if opens is None else (np.degrees(opens) if turns else 1000 * opens),
                "axis": None if fitted.joint is None else fitted.joint.axis.tolist(),
                "point": None if fitted.joint is None else fitted.joint.point.tolist(),
                "confidence": 100 * fitted.confidence,
            }
        )
    return rows


def warn_of_runaways(rows: list[dict[str, Any]], scene: PartScene, notes: Notes) -> None:
    """Warn of parts that move farther than the scene is wide: their motion is poorly determined.

    Args:
        rows: from `part_rows`.
        scene: the parts.
        notes: receives the warning.
    """
    means = np.asarray(scene.gaussians.means, np.float64)
    low, high = np.quantile(means[np.isfinite(means).all(axis=1)], _QUANTILES, axis=0)
    width = 1000 * float(np.linalg.norm(high - low))
    strays = [row for row in rows if row["moved_mm"] > width]
    if strays:
        which = ", ".join(f"{row['part']} ({row['gaussians']} Gaussians)" for row in strays)
        notes.warn(f"parts that leave the scene, so that their motion cannot be trusted: {which}")


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
    """Scores of the scene; those of each part are added to its row. Empty if the recording has no ground
    truth.

    Args:
        scene, trajectory: the parts, and their motion.
        joints: the joint fitted to each part's motion, by part.
        rows: from `part_rows`; each gets the scores of its part.
        recording: with the ground truth.
        anchor: the canonical frame.
        blend: how rotations of several parts are blended.
        notes: collects what was not scored.

    Returns:
        `ari` (over the Gaussians whose true label is known), `true_parts` (the number that move), `missed`
        (the names of those that no part overlaps by a quarter).
    """
    sequence = recording.tracked
    truth = sequence.truth
    if truth is None or not truth.names:
        return {}
    has_both = sequence.has_masks and sequence.has_depth
    labels = true_labels_at(sequence, anchor, np.asarray(scene.gaussians.means)) if has_both else None
    if labels is None and truth.joints:
        return _score_joints(scene, trajectory, joints, rows, truth, anchor, notes)
    if labels is None:
        notes.add("Parts were not scored: assigning Gaussians to true parts requires masks and depth.")
        return {}
    poses = {int(label): truth.poses[:, k] for k, label in enumerate(truth.label_ids)}
    scores = score_tracks(_tracks(scene, trajectory, blend), labels, poses, anchor)
    means = np.asarray(scene.gaussians.means, np.float64)
    # An object without Gaussians is judged by points around its true position: if it moves, it was missed.
    ways = {k: relative_motion(pose, anchor) for k, pose in poses.items()}
    around = {k: pose[anchor, :3, 3] + _AROUND for k, pose in poses.items()}
    moved = {k: _moved_mm(ways[k], means[labels == k] if k in labels else around[k]) for k in poses}
    moving = [label for label in poses if moved[label].max() > _STILL_MM]
    known = np.where(np.isin(labels, [-1, *moving]), labels, BACKGROUND)
    found, there = np.asarray(scene.labels), np.asarray(trajectory.opacities) > 0
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
        _score_joint(row, joints[part], joint_of[label], means[found == part], anchor, there[:, part])
    missed = [names[label] for label in moving if label not in pairs]
    _note_unmatched([names[label] for label in poses if label not in moving], missed, notes)
    return {
        "ari": adjusted_rand_index(found, known),
        "true_parts": len(moving),
        "missed": missed,
    }


def _score_joint(
    row: dict[str, Any],
    fitted: FittedJoint,
    joint: Joint | None,
    points: Float[np.ndarray, "n 3"],
    anchor: int,
    there: Bool[np.ndarray, "T"],
) -> None:
    """Add the errors of a part's joint to its row, if there is a true joint to compare it with; over the
    frames in which the part is `there`, to which its joint was fitted."""
    if joint is not None and fitted.joint is not None:
        true = replace(joint, values=joint.values[there])
        row |= joint_error(fitted.joint, true, points.mean(0), int(there[:anchor].sum()))._asdict()
        row["value"] = row["value_deg"] if joint.kind == "revolute" else row["value_mm"]


def _score_joints(
    scene: PartScene,
    trajectory: Trajectory,
    joints: dict[int, FittedJoint],
    rows: list[dict[str, Any]],
    truth: Truth,
    anchor: int,
    notes: Notes,
) -> dict[str, Any]:
    """Scores where the true part of each Gaussian is unknown: each part, largest first, is matched with the
    true motion most similar to its own, if the two differ by less than half of how far the part moved."""
    notes.add("Each part is compared with the true joint that moves it most alike; there are no masks.")
    means, labels = np.asarray(scene.gaussians.means, np.float64), np.asarray(scene.labels)
    motions, there = motions_in_world(scene, trajectory), np.asarray(trajectory.opacities) > 0
    ways = {k: relative_motion(truth.poses[:, k], anchor) for k in range(len(truth.names))}
    moving = {k: way for k, way in ways.items() if _moved_mm(way, means).max() > _STILL_MM}
    left = dict(moving)
    for row in sorted(rows, key=lambda row: -row["gaussians"]):
        points, shown = means[labels == row["part"]], there[:, row["part"]]
        if not len(points) or not left:
            continue
        back = np.linalg.inv(motions[:, row["part"]])  # rigid: |motion x - way x| = |x - back way x|
        off = {k: _moved_mm((back @ way)[shown], points) for k, way in left.items()}
        best = min(off, key=lambda k: off[k].max())
        if off[best].max() < 0.5 * row["moved_mm"]:
            del left[best]
            row |= {"true_name": truth.names[best], "point_error_mm": float(off[best].mean())}
            _score_joint(row, joints[row["part"]], truth.joints[best], points, anchor, shown)
    missed = [truth.names[k] for k in left]
    _note_unmatched([truth.names[k] for k in ways if k not in moving], missed, notes)
    return {"true_parts": len(moving), "missed": missed}


def _note_unmatched(still: list[str], missed: list[str], notes: Notes) -> None:
    """Note which true parts count as background, and warn of moving ones that were not found."""
    if still:
        notes.add(f"Counted as background, because they do not move: {', '.join(still)}.")
    if missed:
        notes.warn(f"moving objects that no part was found for: {', '.join(missed)}")


def _tracks(scene: PartScene, trajectory: Trajectory, blend: Blend) -> Float[np.ndarray, "T N 3"]:
    """The centres of all Gaussians over time."""
    means = jax.jit(lambda now: gaussians_at(scene, now, blend).means)
    return np.stack([means(moment(trajectory, t)) for t in range(len(trajectory.times))])


def _moved_mm(
    motions: Float[np.ndarray, "T 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "T"]:
    """How far the points are displaced at each time, on average; 0 without points."""
    if not len(points):
        return np.zeros(len(motions))
    moved = np.einsum("tij,nj->tni", motions[:, :3, :3], points) + motions[:, None, :3, 3]
    return 1000 * np.linalg.norm(moved - points, axis=-1).mean(-1)
