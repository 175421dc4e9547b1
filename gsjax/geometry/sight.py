"""Projection of points, and rays of pixels, for pinhole and fisheye cameras; on the host.

In the image of a fisheye (Kannala and Brandt, PAMI 28(8), 2006, in OpenCV's form) a point at an angle theta
off axis appears at the distance

    d(theta) = theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9

from the principal point, in units of the focal length, up to the angle where d ceases to grow.
"""

import numpy as np
from jaxtyping import Float

_STEPS = 4096  # entries of the table of d, which is interpolated
_WIDEST = 3.0  # radians off axis


def radial_table(
    coeffs: Float[np.ndarray, "4"], widest: float = _WIDEST
) -> tuple[Float[np.ndarray, "steps"], Float[np.ndarray, "steps"]]:
    """Angles off axis, and the distances from the principal point at which they appear, both increasing.

    Args:
        coeffs: k1 to k4.
        widest: largest angle, radians.
    """
    angles = np.linspace(0.0, widest, _STEPS)
    distances = angles * np.polyval([*coeffs[::-1], 1.0], angles**2)
    shrinks = np.flatnonzero(np.diff(distances) <= 0)
    end = len(angles) if not len(shrinks) else shrinks[0] + 1
    return angles[:end], distances[:end]


def rays(
    pixels: Float[np.ndarray, "*n 2"],
    K: Float[np.ndarray, "3 3"],
    fisheye: Float[np.ndarray, "4"] | None = None,
) -> Float[np.ndarray, "*n 3"]:
    """Rays of pixels in the camera's frame, as vectors of depth 1: with z = 1 for a pinhole, and of length 1
    for a fisheye, where they are NaN for pixels outside the lens's image circle.

    Args:
        pixels: (x, y), centres at +0.5.
        K: intrinsics, pixels.
        fisheye: k1 to k4; None: a pinhole.
    """
    if fisheye is None:
        return np.concatenate([pixels, np.ones((*pixels.shape[:-1], 1))], axis=-1) @ np.linalg.inv(K).T
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1]
    x = (pixels[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    far = np.hypot(x, y)
    angles, distances = radial_table(fisheye)
    angle = np.interp(far, distances, angles, right=np.nan)
    across = np.sin(angle) / np.maximum(far, 1e-12)
    return np.stack([across * x, across * y, np.cos(angle)], axis=-1)


def pixels_at(
    local: Float[np.ndarray, "*n 3"],
    K: Float[np.ndarray, "3 3"],
    fisheye: Float[np.ndarray, "4"] | None = None,
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
    """Pixel positions and depths of points in the camera's frame; positions are NaN for points behind a
    pinhole, and for points outside the field of view of a fisheye.

    Args:
        local: points.
        K, fisheye: the camera, as for `rays`.
    """
    if fisheye is None:
        depths = local[..., 2]
        return (local @ K.T)[..., :2] / np.where(depths > 0, depths, np.nan)[..., None], depths
    across = np.linalg.norm(local[..., :2], axis=-1)
    angles, distances = radial_table(fisheye)
    far = np.interp(np.arctan2(across, local[..., 2]), angles, distances, right=np.nan)
    x, y = np.moveaxis(local[..., :2] * (far / np.maximum(across, 1e-12))[..., None], -1, 0)
    pixels = np.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)
    return pixels, np.linalg.norm(local, axis=-1)
