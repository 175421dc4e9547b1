"""Scores of a run, added up view by view so that memory stays flat, and the metrics that come of them."""

from typing import Any

import numpy as np
from jaxtyping import Bool

from gsjax.engine.recording import FirstMask, Recording, label_names
from gsjax.engine.scores import Scores, camera_metrics, motion_metrics
from gsjax.engine.track.loop import Tracking
from gsjax.methods.track.budget import Chosen
from gsjax.metrics.tracking import ObjectScore, score_tracks, true_labels


def group_values(tracking: Tracking, mask: FirstMask, recording: Recording) -> np.ndarray | None:
    """The mask value in the data's files that each group stands for, [K+1]; None if there are no files.

    Groups of the segmenter stand for the value that most of their pixels have in the file's first mask.
    """
    values = np.asarray(tracking.scene.label_ids)
    if mask.source != "segment":
        return values
    c = recording.tracked.camera_ids.index(mask.camera)
    files = recording.tracked.mask(0, c)
    if files is None or mask.labels is None:
        return None
    matched = [0]
    for value in values[1:]:
        found, counts = np.unique(files[mask.labels == value], return_counts=True)
        matched.append(int(found[np.argmax(counts)]) if len(found) else 0)
    return np.asarray(matched)


def score_motion(tracking: Tracking, recording: Recording) -> dict[int, ObjectScore]:
    """How each object of the truth was followed, by its mask value; empty without truth, depth or masks."""
    sequence = recording.tracked
    truth = sequence.truth
    if truth is None or not (sequence.has_masks and sequence.has_depth) or tracking.num_frames < 2:
        return {}  # the first frame is what errors are counted from
    seen = [(sequence.mask(0, c), sequence.depth(0, c), c) for c in range(sequence.num_cameras)]
    seen = [(mask, depth, c) for mask, depth, c in seen if mask is not None and depth is not None]
    if not seen:
        return {}
    masks, depths, cameras = zip(*seen, strict=True)
    means = tracking.means()
    labels = true_labels(
        means[0],
        masks,
        depths,
        [sequence.viewmats[0, c] for c in cameras],
        [sequence.Ks[0, c] for c in cameras],
    )
    poses = truth.poses[: tracking.num_frames]
    return score_tracks(means, labels, {int(k): poses[:, i] for i, k in enumerate(truth.label_ids)})


def metrics(
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    scores: Scores,
    motion: dict[int, ObjectScore],
    values: np.ndarray | None,
) -> dict[str, Any]:
    """The scores of metrics.json; what was not scored is None: the motion of an object that is not tracked,
    though some Gaussian may lie on it. docs/track.md explains each score.

    Args:
        tracking: the scene and its poses.
        recording: what judges.
        mask: the first one.
        scores: of views.
        motion: of objects, by mask value.
        values: the mask value of each group, [K+1], or None.
    """
    names = object_names(tracking, recording, mask, values)
    motion = {label: score for label, score in motion.items() if _members(tracking, values, label).any()}
    objects = {
        name: {
            "label": label,
            "gaussians": _count_gaussians(tracking, values, label),
            "mask_pixels": _pixels(mask, tracking, values, label),
            "travelled_mm": _travelled_mm(tracking, values, label),
            "frames_lost": _frames_lost(tracking, values, label),
            "turn_unknown_from": turn_unknown_from(tracking, values, label),
            **motion_metrics(motion.get(label)),
        }
        for label, name in names.items()
    }
    return {
        "objects": objects,
        "iou": _iou(scores, names, held_out=False),
        "iou_held_out": _iou(scores, names, held_out=True),
        **camera_metrics(scores),
        "over_frames": {
            "psnr": {str(camera): found.values["psnr"] for camera, found in scores.cameras.items()},
            "centroid_error_mm": {
                names[label]: score.centroid_errors_mm for label, score in motion.items() if label in names
            },
        },
    }


def budget_metrics(chosen: Chosen) -> dict[str, Any]:
    """What was chosen for a budget, and why, for metrics.json."""
    tried = {
        name: {"base_ms": 1e3 * costs.base, "each_search_ms": 1e3 * costs.search}
        for name, costs in chosen.tried.items()
    }
    return {"chosen": chosen.name, "fits": chosen.fits, "measured": tried}


def object_names(
    tracking: Tracking, recording: Recording, mask: FirstMask, values: np.ndarray | None
) -> dict[int, str]:
    """The name of each object that is tracked or in the truth, by mask value, background left out."""
    known = label_names(recording, "files")
    ids = tracking.scene.label_ids if values is None else values.tolist()
    labels = sorted({*ids, *(known if values is not None else {})} - {0})
    return {
        label: known.get(label, f"object {label}") if values is not None else f"object {label}"
        for label in labels
    }


def _iou(scores: Scores, names: dict[int, str], held_out: bool) -> dict[str, float]:
    overlap = scores.overlaps[held_out]
    return {name: overlap.iou(label) for label, name in names.items() if label in overlap.labels}


def _members(tracking: Tracking, values: np.ndarray | None, label: int) -> np.ndarray:
    """Which Gaussians the tracker takes for the object."""
    ids = np.asarray(tracking.scene.label_ids) if values is None else values
    return np.isin(np.asarray(tracking.scene.labels), np.flatnonzero(ids == label))


def _count_gaussians(tracking: Tracking, values: np.ndarray | None, label: int) -> int:
    return int(_members(tracking, values, label).sum())


def _travelled_mm(tracking: Tracking, values: np.ndarray | None, label: int) -> float | None:
    """How far the tracker moved the object's centroid from where it was first, at most."""
    members = _members(tracking, values, label)
    if not members.any():
        return None
    centroids = tracking.means()[:, members].mean(axis=1)
    return 1e3 * float(np.linalg.norm(centroids - centroids[0], axis=-1).max())


def _frames_lost(tracking: Tracking, values: np.ndarray | None, label: int) -> int | None:
    lost = lost_over_frames(tracking, values, label)
    return int(lost.sum()) if _members(tracking, values, label).any() else None


def lost_over_frames(
    tracking: Tracking, values: np.ndarray | None, label: int
) -> Bool[np.ndarray, "updates"]:
    """In which updates the tracker held the object, or a part of it, for lost.

    Args:
        tracking: the scene and the tracker's flags.
        values: the mask value of each group, [K+1], or None.
        label: the object's.
    """
    return _of_object(tracking, tracking.lost, values, label).any(axis=1)


def turn_unknown(tracking: Tracking, values: np.ndarray | None, label: int) -> Bool[np.ndarray, "updates"]:
    """After which updates the tracker did not know how the object, or a part of it, is turned.

    Args:
        tracking, values, label: as for `lost_over_frames`.
    """
    return ~_of_object(tracking, tracking.turn_known, values, label).all(axis=1)


def turn_unknown_from(tracking: Tracking, values: np.ndarray | None, label: int) -> int | None:
    """The frame from which on, to the end, the tracker did not know how the object is turned, lost or not;
    None if it knew at the end.

    Args:
        tracking, values, label: as for `lost_over_frames`.
    """
    known = np.flatnonzero(~turn_unknown(tracking, values, label))
    first = known[-1] + 2 if len(known) else 1
    return int(first) if first < tracking.num_frames else None


def _of_object(
    tracking: Tracking, flags: list[np.ndarray], values: np.ndarray | None, label: int
) -> Bool[np.ndarray, "updates parts"]:
    """The flags of one object's groups."""
    ids = np.asarray(tracking.scene.label_ids) if values is None else values
    return np.asarray(flags, bool).reshape(len(flags), len(ids) - 1)[:, ids[1:] == label]


def _pixels(mask: FirstMask, tracking: Tracking, values: np.ndarray | None, label: int) -> int | None:
    if mask.labels is None:
        return None
    ids = np.asarray(tracking.scene.label_ids)
    own = ids[values == label] if values is not None else [label]
    return int(np.isin(mask.labels, [label] if mask.source == "files" else own).sum())
