"""Checks of cameras, poses, times and depth, whose messages name the location and the remedy."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError, DataWarning
from gsjax.geometry.neighbors import valid_depth

ROTATION_TOLERANCE = 1e-2
"""Largest accepted entry of |R^T R - I|; calibrations are often written with few digits."""

_UNIT_TOLERANCE = 1e-2  # on a quaternion's length: files often have few digits

FARTHEST_MEDIAN_M, NEAREST_MEDIAN_M = 50.0, 0.02
"""A median depth outside this range means a wrong unit rather than an unusual scene."""


def check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    """Raises ValueError unless an array has the expected shape.

    Args:
        name: name of the array, for the message.
        array: the array to check.
        shape: the expected shape.
    """
    if np.shape(array) != shape:
        raise ValueError(f"{name} must have shape {shape}, got {np.shape(array)}")


def check_loaded(where: str, array: np.ndarray | None, shape: tuple[int, ...], kind: type) -> None:
    """Raises DataError unless what a loader returned has the expected shape and type.

    Args:
        where: the file, or a description of the data, for the message.
        array: what was loaded.
        shape: the expected shape.
        kind: the expected type, or a group of them: np.uint8, np.integer, np.floating.
    """
    if array is None or array.shape != shape or not np.issubdtype(array.dtype, kind):
        type_name = {np.floating: "floats", np.integer: "integers"}.get(kind) or np.dtype(kind).name
        found = "nothing" if array is None else f"shape {array.shape} of {array.dtype}"
        advice = "Correct the file or its loader."
        is_depth = kind is np.floating and len(shape) == 2
        if is_depth and array is not None and array.dtype.kind in "iu":
            advice = "Give metres as floats: divide millimetres by 1000."
        raise DataError(where, f"shape {shape} of {type_name}", found, advice)


def check_background(background: tuple[float, float, float] | None) -> None:
    """Raises ValueError unless a background colour is RGB from 0 to 1, or None."""
    if background is not None and not (len(background) == 3 and all(0 <= c <= 1 for c in background)):
        raise ValueError(f"background: expected RGB from 0 to 1, found {background}; divide bytes by 255")


def positions_of(indices: Any, count: int) -> list[int]:
    """Positions in a list of `count` items, given as positions or as a mask.

    Raises:
        ValueError: a mask has another length.
    """
    found = np.asarray(indices)
    if found.dtype != bool:
        return [int(i) for i in found]
    if found.shape != (count,):
        raise ValueError(f"expected positions, or a mask of length {count}, found a mask of {found.shape}")
    return np.flatnonzero(found).tolist()


def check_poses(
    name: str, poses: Float[np.ndarray, "frames things 4 4"], where: Callable[[int, int], str], advice: str
) -> None:
    """Check that every matrix is a rigid motion.

    Args:
        name: name of the matrices, for the message.
        poses: the matrices of things in frames.
        where: (frame, thing) -> description of that entry, for the message.
        advice: last sentence of the message.

    Raises:
        ValueError: a matrix is not finite, its last row is not 0 0 0 1, or its upper left 3x3 is not a
            rotation; the message contains `where(frame, thing)` and ends with `advice`.
    """
    rotations = poses[..., :3, :3]
    finite = np.isfinite(poses).all((-1, -2))
    safe = np.where(finite[..., None, None], rotations, np.eye(3))
    skew = np.abs(np.swapaxes(safe, -1, -2) @ safe - np.eye(3)).max((-1, -2))
    problems = [
        (~finite, lambda i: "it contains NaN or infinity"),
        (np.abs(poses[..., 3, :] - [0, 0, 0, 1]).max(-1) > 1e-6, lambda i: f"its last row is {poses[i][3]}"),
        (skew > ROTATION_TOLERANCE, lambda i: f"R is not a rotation: |R^T R - I| reaches {skew[i]:.3g}"),
        (np.linalg.det(safe) < 0, lambda i: "R is a reflection: its determinant is negative"),
    ]
    for bad, describe in problems:
        if bad.any():
            frame, thing = (int(i) for i in np.argwhere(bad)[0])
            raise ValueError(f"{name} of {where(frame, thing)}: {describe((frame, thing))}. {advice}")


def check_quaternions(quats: Float[np.ndarray, "n 4"], where: Callable[[int], str], advice: str) -> None:
    """Check that every quaternion has length 1, apart from rounding to few digits.

    Args:
        quats: the quaternions.
        where: row -> file and place of that quaternion, for the message.
        advice: last sentence of the message.

    Raises:
        DataError: one has another length.
    """
    lengths = np.hypot.reduce(quats, axis=1)
    odd = np.flatnonzero(~(np.abs(lengths - 1) <= _UNIT_TOLERANCE))
    if len(odd):
        found = f"one of length {lengths[odd[0]]:.3g}"
        raise DataError(where(int(odd[0])), "a quaternion of length 1", found, advice)


def check_intrinsics(Ks: Float[np.ndarray, "frames cameras 3 3"], where: Callable[[int, int], str]) -> None:
    """Raises ValueError if a K is not finite, has a focal length <= 0, or a last row other than 0 0 1."""
    bad = ~np.isfinite(Ks).all((-1, -2)) | (Ks[..., 0, 0] <= 0) | (Ks[..., 1, 1] <= 0)
    bad |= np.abs(Ks[..., 2, :] - [0, 0, 1]).max(-1) > 1e-6
    if bad.any():
        frame, camera = (int(i) for i in np.argwhere(bad)[0])
        found = Ks[frame, camera].tolist()
        raise ValueError(
            f"K of {where(frame, camera)} is {found}: it must be finite, with positive focal lengths "
            "and 0 0 1 as its last row. Correct the calibration."
        )


def check_times(times: Float[np.ndarray, "frames"], *, shared: bool = False) -> None:
    """Raises ValueError unless there is at least one time and all are finite and increase.

    Args:
        times: seconds.
        shared: whether neighbours may be equal.
    """
    if len(times) == 0:
        raise ValueError("a sequence needs at least one frame, got none. Choose other frames.")
    bad = ~np.isfinite(times)
    steps = np.diff(times)
    bad[1:] |= ~(steps >= 0 if shared else steps > 0)
    if bad.any():
        frame = int(np.argmax(bad))
        before = f" after {times[frame - 1]} s" if frame else ""
        order, advice = ("not decrease", "") if shared else ("increase", " and drop duplicates")
        raise ValueError(
            f"times must be finite and {order}, but frame {frame} is at {times[frame]} s{before}. "
            f"Sort the frames{advice}."
        )


def usable_depth(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """The depth in float32, with pixels set to 0 (invalid) that are not finite, not above 0, or endless."""
    return np.where(valid_depth(depth), depth, 0).astype(np.float32)


def check_depth(depth: Float[np.ndarray, "height width"], what: str) -> Float[np.ndarray, "height width"]:
    """`usable_depth`, after a check of its range.

    Warns with DataWarning if no pixel is valid.

    Raises:
        DataError: the median of the valid pixels is above 50 m or below 20 mm: the unit is wrong.
    """
    depth = usable_depth(depth)
    valid = depth[depth > 0]
    if valid.size == 0:
        warnings.warn(f"{what}: no pixel has a valid depth", DataWarning, stacklevel=3)
        return depth
    median = float(np.median(valid))
    if not NEAREST_MEDIAN_M <= median <= FARTHEST_MEDIAN_M:
        expected = f"depth in metres with a median from {NEAREST_MEDIAN_M} to {FARTHEST_MEDIAN_M}"
        advice = (
            "The unit is likely wrong: set depth_unit_m (--read.depth-unit-m), the metres per step of the "
            "depth image; 0.001 for millimetres."
        )
        raise DataError(what, expected, f"a median of {median:.4g} m", advice)
    return depth
