"""Rigid transforms and smooth keyframe motions, vectorised over frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def rigid(
    rotation: Rotation | None, translation: Float[np.ndarray, "*frames 3"] | Sequence[float]
) -> Float[np.ndarray, "*frames 4 4"]:
    """Transforms that rotate, then translate; the rotation is one, a batch, or None for the identity."""
    translation = np.asarray(translation, np.float64)
    matrices = np.eye(3) if rotation is None else rotation.as_matrix()
    batch = np.broadcast_shapes(translation.shape[:-1], matrices.shape[:-2])
    transforms = np.zeros((*batch, 4, 4))
    transforms[..., :3, :3], transforms[..., :3, 3], transforms[..., 3, 3] = matrices, translation, 1.0
    return transforms


def minimum_jerk(x: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Minimum-jerk ramp from 0 to 1 for x from 0 to 1, at rest at both ends; its steepest slope is 15/8."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x * x)


def along_keyframes(
    frames: Float[np.ndarray, "t"], keys: Sequence[float], values: Sequence[Sequence[float]]
) -> Float[np.ndarray, "t d"]:
    """Values that pass through `values` at the frames `keys`, at rest at each of them."""
    points = np.asarray(values, np.float64)
    result = np.broadcast_to(points[0], (len(frames), points.shape[1])).copy()
    for i in range(len(keys) - 1):
        share = minimum_jerk((frames - keys[i]) / (keys[i + 1] - keys[i]))
        result += share[:, None] * (points[i + 1] - points[i])
    return result


def coast(frames: Float[np.ndarray, "t"], start: float, duration: float) -> Float[np.ndarray, "t"]:
    """Progress from 0 to 1 of a pushed object under friction: fastest at `start`, at rest after `duration`
    frames.

    The first frame covers at most 2 / duration of the path.
    """
    x = np.clip((frames - start) / duration, 0.0, 1.0)
    return x * (2 - x)


def turn(axis: Float[np.ndarray, "3"] | Sequence[float], angles: Float[np.ndarray, "*n"] | float) -> Rotation:
    """Rotations about one unit axis, by angles in radians."""
    return Rotation.from_rotvec(np.asarray(angles)[..., None] * np.asarray(axis, np.float64))


def between(
    start: Float[np.ndarray, "*frames 3"], end: Float[np.ndarray, "*frames 3"]
) -> Float[np.ndarray, "*frames 4 4"]:
    """The frame at the midpoint of a segment: z points from start to end, x stays horizontal."""
    z = (end - start) / np.linalg.norm(end - start, axis=-1, keepdims=True)
    x = np.cross(np.array([0.0, 0.0, 1.0]), z)
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    x = np.where(length > 1e-6, x / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
    x = x - np.sum(x * z, axis=-1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    transforms = rigid(None, (start + end) / 2)
    transforms[..., :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    return transforms
