"""Scores of a tracked recording, for its metrics.json."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Int, Shaped

from gsjax.engine.first_mask import FirstMask, label_names
from gsjax.engine.recording import Recording
from gsjax.engine.scores import Scores, camera_metrics, motion_metrics, true_labels_at
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.poses import pose_metrics
from gsjax.methods.track.budget import Chosen
from gsjax.metrics.tracking import ObjectScore, score_tracks


def group_values(tracking: Tracking, mask: FirstMask, recording: Recording) -> np.ndarray | None:
    """The mask value in the data's files that each group stands for, [K+1]; None if there are no files.

    A group of another mask stands for the value that most of its pixels have in the file's first mask.
    """
    values = np.asarray(tracking.scene.label_ids)
    if mask.is_own:
        return values
    files = recording.tracked.mask(0, recording.tracked.camera_ids.index(mask.camera))
    if files is None or mask.labels is None:
        return None
    matched = [0]
    for value in values[1:]:
        found, counts = np.unique(files[mask.labels == value], return_counts=True)
        matched.append(int(found[np.argmax(counts)]) if len(found) else 0)
    return np.asarray(matched)


def labels_of_groups(tracking: Tracking, values: np.ndarray | None) -> np.ndarray:
    """The label of each group of a tracking, [K+1]: its value from `group_values` or, if that is None, its
    value in the first mask."""
    return np.asarray(tracking.scene.label_ids) if values is None else values


def score_motion(
    tracking: Tracking, recording: Recording, labels: Int[np.ndarray, "N"] | None
) -> dict[int, ObjectScore]:
    """How well the motion of each object in the ground truth was tracked, by its mask value; empty without
    ground truth, depth or masks.

    Args:
        tracking: the scene and its poses.
        recording: the recording, with its truth.
        labels: from `first_labels`.
    """
    truth = recording.tracked.truth
    if truth is None or labels is None or tracking.num_frames < 2:
        return {}  # errors are relative to the first frame
    poses = {int(k): truth.poses[: tracking.num_frames, i] for i, k in enumerate(truth.label_ids)}
    return score_tracks(tracking.means(), labels, poses)


def first_labels(tracking: Tracking, recording: Recording) -> Int[np.ndarray, "N"] | None:
    """The true label of each Gaussian of the first frame; None without masks or depth."""
    sequence = recording.tracked
    if not (sequence.has_masks and sequence.has_depth):
        return None
    return true_labels_at(sequence, 0, tracking.means()[0])


def metrics(
    tracking: Tracking,
    recording: Recording,
    mask: FirstMask,
    scores: Scores,
    motion: dict[int, ObjectScore],
    values: np.ndarray | None,
    true_labels: Int[np.ndarray, "N"] | None,
) -> dict[str, Any]:
    """The scores of metrics.json; what was not scored is None, for example the motion of an object that
    is not tracked. docs/track.md explains each score.

    Args:
        tracking: the scene and its poses.
        recording: the recording, with its truth.
        mask: the first mask.
        scores: those of views.
        motion: those of objects, by mask value.
        values: the mask value of each group, [K+1], or None.
        true_labels: from `first_labels`.
    """
    names = object_names(tracking, recording, values)
    ids, label_ids = labels_of_groups(tracking, values), np.asarray(tracking.scene.label_ids)
    groups, means = np.asarray(tracking.scene.labels), tracking.means()
    poses = {} if values is None else pose_metrics(tracking, recording.tracked, values, true_labels)
    objects = {}
    for label, name in names.items():
        members = np.isin(groups, np.flatnonzero(ids == label))
        is_tracked, pixels = members.any(), None
        if mask.labels is not None:
            own = [label] if mask.source == "files" or values is None else label_ids[ids == label]
            pixels = int(np.isin(mask.labels, own).sum())
        centroids = means[:, members].mean(axis=1) if is_tracked else None
        objects[name] = {
            "label": label,
            "gaussians": int(members.sum()),
            "mask_pixels": pixels,
            "travelled_mm": None
            if centroids is None
            else 1e3 * float(np.linalg.norm(centroids - centroids[0], axis=-1).max()),
            "frames_lost": int(lost_over_frames(tracking, values, label).sum()) if is_tracked else None,
            **_agreement(tracking, values, label),
            "turn_unknown_from": turn_unknown_from(tracking, values, label),
            **motion_metrics(motion.get(label) if is_tracked else None),
            "pose": poses.get(label),
        }
    followed = {
        name: motion[label].centroid_errors_mm
        for label, name in names.items()
        if label in motion and objects[name]["gaussians"]
    }
    return {
        "objects": objects,
        "iou": _iou(scores, names, held_out=False),
        "iou_held_out": _iou(scores, names, held_out=True),
        **camera_metrics(scores),
        "over_frames": {
            "psnr": {str(camera): found.values["psnr"] for camera, found in scores.cameras.items()},
            "centroid_error_mm": followed,
        },
    }


def budget_metrics(chosen: Chosen) -> dict[str, Any]:
    """The settings chosen for a budget, and the measured costs, for metrics.json."""
    tried = {
        name: {"base_ms": 1e3 * costs.base, "each_search_ms": 1e3 * costs.search}
        for name, costs in chosen.tried.items()
    }
    return {"chosen": chosen.name, "fits": chosen.fits, "measured": tried}


def object_names(tracking: Tracking, recording: Recording, values: np.ndarray | None) -> dict[int, str]:
    """The name of each object that is tracked or in the ground truth, by label, without the background.

    Args:
        tracking: the scene.
        recording: the recording, with the names of its mask values.
        values: the mask value of each group, [K+1], or None.
    """
    names = {} if values is None else label_names(recording, "files")
    known = {} if values is None else recording.tracked.known_objects
    labels = sorted({*labels_of_groups(tracking, values).tolist(), *known} - {0})
    return {label: names.get(label, f"object {label}") for label in labels}


def _iou(scores: Scores, names: dict[int, str], held_out: bool) -> dict[str, float]:
    """IoU of each object; none in the tracked cameras where only the first of several frames has masks, from
    which tracking started."""
    if not held_out and scores.num_frames > 1 and not scores.later_masks[False]:
        return {}
    overlap = scores.overlaps[held_out]
    return {name: overlap.iou(label) for label, name in names.items() if label in overlap.labels}


def lost_over_frames(
    tracking: Tracking, values: np.ndarray | None, label: int
) -> Bool[np.ndarray, "updates"]:
    """In which updates the tracker considered the object, or a part of it, lost.

    Args:
        tracking: the scene and the tracker's flags.
        values: the mask value of each group, [K+1], or None.
        label: the object's.
    """
    return np.any(_of_object(tracking, tracking.lost, values, label), axis=1)


def _agreement(tracking: Tracking, values: np.ndarray | None, label: int) -> dict[str, float | None]:
    """The fraction of what is seen of an object, or of its worst part, that agrees with the pictures: the
    least over all updates, and that of the last one; None where nothing of it was seen."""
    shares = _of_object(tracking, tracking.agrees, values, label, float)
    shares = np.where(_of_object(tracking, tracking.visible, values, label), shares, np.inf)
    least = shares.min(axis=1, initial=np.inf)
    known = {"agrees_least": least.min(initial=np.inf), "agrees_last": least[-1] if len(least) else np.inf}
    return {name: float(share) if np.isfinite(share) else None for name, share in known.items()}


def turn_unknown(tracking: Tracking, values: np.ndarray | None, label: int) -> Bool[np.ndarray, "updates"]:
    """After which updates the tracker did not know the rotation of the object, or of a part of it.

    Args:
        tracking, values, label: as for `lost_over_frames`.
    """
    return ~np.all(_of_object(tracking, tracking.turn_known, values, label), axis=1)


def turn_unknown_from(tracking: Tracking, values: np.ndarray | None, label: int) -> int | None:
    """The first frame from which on the tracker no longer knew the object's rotation, lost or not, until the
    end; None if it knew it at the end.

    Args:
        tracking, values, label: as for `lost_over_frames`.
    """
    known = np.flatnonzero(~turn_unknown(tracking, values, label))
    first = known[-1] + 2 if len(known) else 1
    return int(first) if first < tracking.num_frames else None


def _of_object(
    tracking: Tracking, rows: list[np.ndarray], values: np.ndarray | None, label: int, kind: type = bool
) -> Shaped[np.ndarray, "updates parts"]:
    """The values of one object's groups in each update; `rows` has those of all groups."""
    ids = labels_of_groups(tracking, values)
    return np.asarray(rows, kind).reshape(len(rows), len(ids) - 1)[:, ids[1:] == label]
