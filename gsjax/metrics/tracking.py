"""Error of tracked Gaussians against the true motion of their object.

With x_t the Gaussian's centre at frame t and T_t the object's true pose (object to world), a perfect tracker
has x_t = T_t T_0^-1 x_0. The error covers rotation as well as translation. If a method starts at a frame
other than 0, motion is measured from that frame, its anchor. In float64, on the host.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Integer
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import pixels_of
from gsjax.metrics.segmentation import IGNORED_LABEL

_ORTHONORMALITY = 1e-3


class ObjectScore(NamedTuple):
    """The tracking errors of one object, in millimetres.

    Attributes:
        centroid_error_mm: mean over time of || mean_i x_t - T_t T_0^-1 mean_i x_0 ||.
        centroid_errors_mm: the same per frame.
        point_error_mm: mean over Gaussians and time of || x_t - T_t T_0^-1 x_0 ||.
        median_point_error_mm: median of the same distances.
        moved_mm: largest distance over time of the true centroid from its position at the anchor.
        turned_deg: largest true rotation from the anchor, degrees.
        num_scored: number of Gaussians with this true label.
    """

    centroid_error_mm: float
    centroid_errors_mm: Float[np.ndarray, "T"]
    point_error_mm: float
    median_point_error_mm: float
    moved_mm: float
    turned_deg: float
    num_scored: int


def true_labels(
    points: Float[np.ndarray, "N 3"],
    masks: Sequence[Integer[np.ndarray, "..."]],
    depths: Sequence[Float[np.ndarray, "..."]],
    viewmats: Sequence[Float[np.ndarray, "4 4"]],
    Ks: Sequence[Float[np.ndarray, "3 3"]],
    *,
    max_depth_gap: float = 0.015,
) -> Int[np.ndarray, "N"]:
    """The true label of each Gaussian, from the masks and depths of the first frame; -1 where unknown.

    A camera sees a centre that projects into its image at a z within `max_depth_gap` metres of the depth
    there; the label is the mask's value. If several cameras see it, the one whose depth agrees best decides.
    A centre that no camera sees is unknown and not scored.

    Args:
        points: centres at frame 0, world, metres.
        masks, depths: [H, W] for each camera; depth in metres, 0 where invalid.
        viewmats, Ks: world to camera (OpenCV), and intrinsics with pixel centres at +0.5, of each camera.

    Raises:
        ValueError: the numbers of masks, depths and cameras differ, or a mask and its depth differ in size.
    """
    counts = {len(masks), len(depths), len(viewmats), len(Ks)}
    if len(counts) > 1:
        raise ValueError(
            f"true_labels: expected one mask, depth, viewmat and K per camera, found {len(masks)} masks, "
            f"{len(depths)} depths, {len(viewmats)} viewmats and {len(Ks)} Ks"
        )
    labels = np.full(len(points), IGNORED_LABEL, np.int32)
    best = np.full(len(points), np.inf)
    for mask, depth, viewmat, K in zip(masks, depths, viewmats, Ks, strict=True):
        if np.shape(mask) != np.shape(depth):
            raise ValueError(
                f"masks: expected shape {np.shape(depth)} to match its depth, found {np.shape(mask)}"
            )
        value, gap = _seen_by(np.asarray(points), np.asarray(mask), np.asarray(depth), viewmat, K)
        better = (gap <= max_depth_gap) & (gap < best)
        labels[better], best[better] = value[better], gap[better]
    return labels


def _seen_by(
    points: np.ndarray, mask: np.ndarray, depth: np.ndarray, viewmat: np.ndarray, K: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The mask's value at each point, and the gap to the depth there; infinite outside or without depth."""
    height, width = depth.shape
    columns, rows, z, inside = pixels_of(points, viewmat, K, width, height)
    there = depth[rows, columns]
    valid = inside & np.isfinite(there) & (there > 0)
    return mask[rows, columns], np.where(valid, np.abs(there - z), np.inf)


def relative_motion(poses: Float[np.ndarray, "T 4 4"], anchor: int = 0) -> Float[np.ndarray, "T 4 4"]:
    """T_t T_0^-1: the motion, in the world, of the object from frame 0 (or `anchor`) to frame t.

    Raises:
        ValueError: a pose is not a rigid motion.
    """
    poses = np.asarray(poses, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise ValueError(f"poses: expected shape [T, 4, 4], found {poses.shape}")
    if not np.isfinite(poses).all():
        frame = int(np.argmin(np.isfinite(poses).all(axis=(1, 2))))
        raise ValueError(f"poses: expected finite numbers, found NaN or infinity at frame {frame}")
    rotations = poses[:, :3, :3]
    gap = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    rigid = (gap < _ORTHONORMALITY) & (np.linalg.det(rotations) > 0)
    if not rigid.all():
        frame = int(np.argmin(rigid))
        raise ValueError(
            f"poses: expected rotations, found none at frame {frame} (R R^T is off by {gap[frame]:.3g})"
        )
    return poses @ np.linalg.inv(poses[anchor])


def score_object(
    means: Float[np.ndarray, "T N 3"], poses: Float[np.ndarray, "poses 4 4"], anchor: int = 0
) -> ObjectScore:
    """Score the Gaussians of one object; without Gaussians, the errors are NaN.

    Args:
        means: centres of the object's Gaussians over time, world, metres.
        poses: the object's true poses, object to world.
        anchor: the frame from which motion is measured, and at which the error is zero.

    Raises:
        ValueError: the frame counts differ, or a pose is not a rigid motion.
    """
    means, motion = np.asarray(means, np.float64), relative_motion(poses, anchor)
    if len(means) != len(motion):
        raise ValueError(f"means: expected {len(motion)} frames like poses, found {len(means)}")
    cosine = (np.trace(motion[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    turned = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max())
    if means.shape[1] == 0:
        missing = float("nan")
        return ObjectScore(missing, np.full(len(means), np.nan), missing, missing, missing, turned, 0)
    expected = np.einsum("tij,nj->tni", motion[:, :3, :3], means[anchor]) + motion[:, None, :3, 3]
    errors = 1000.0 * np.linalg.norm(means - expected, axis=-1)
    centroids = expected.mean(axis=1)
    centroid_errors = 1000.0 * np.linalg.norm(means.mean(axis=1) - centroids, axis=-1)
    return ObjectScore(
        centroid_error_mm=float(centroid_errors.mean()),
        centroid_errors_mm=centroid_errors,
        point_error_mm=float(errors.mean()),
        median_point_error_mm=float(np.median(errors)),
        moved_mm=1000.0 * float(np.linalg.norm(centroids - centroids[anchor], axis=-1).max()),
        turned_deg=turned,
        num_scored=means.shape[1],
    )


def score_tracks(
    means: Float[np.ndarray, "T N 3"],
    labels: Integer[np.ndarray, "labels"],
    poses: Mapping[int, Float[np.ndarray, "poses 4 4"]],
    anchor: int = 0,
) -> dict[int, ObjectScore]:
    """Score each object whose true poses are known.

    Args:
        means: centres over time, world, metres.
        labels: the TRUE label of each Gaussian (see `true_labels`), not the tracker's own.
        poses: true poses of each label over the same frames.
        anchor: the frame from which motion is measured.

    Raises:
        ValueError: the shapes do not agree, or a pose is not a rigid motion.
    """
    means, labels = np.asarray(means), np.asarray(labels)
    if labels.shape != (means.shape[1],):
        raise ValueError(f"labels: expected shape [{means.shape[1]}] to match means, found {labels.shape}")
    return {label: score_object(means[:, labels == label], poses[label], anchor) for label in sorted(poses)}


def carried_points(
    points: Float[np.ndarray, "V 3"], means: Float[np.ndarray, "T N 3"], carriers: int = 4
) -> Float[np.ndarray, "T V 3"]:
    """Positions over time of points carried by Gaussians: each point moves by the mean displacement of the
    Gaussians nearest to it at frame 0.

    Args:
        points: points at frame 0, world, metres.
        means: centres of the Gaussians over time, world, metres.
        carriers: number of Gaussians that carry a point.
    """
    _, nearest = cKDTree(means[0]).query(points, k=[*range(1, min(carriers, means.shape[1]) + 1)])
    return points + (means[:, nearest] - means[0][nearest]).mean(axis=2)
