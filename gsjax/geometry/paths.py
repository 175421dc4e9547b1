"""Camera paths through a scene, for videos. On the host, in float64."""

import numpy as np
from jaxtyping import Float

from gsjax.geometry.cameras import look_at

_WIDEST_GAP = np.deg2rad(120)  # between neighbours in a ring of cameras that still counts as closed
_SWING = np.deg2rad(8)  # amplitude of the path if all cameras are in one direction
_NEAREST = 0.02  # smallest radius of a path, as a fraction of the distance to the focus


def orbit(
    viewmats: Float[np.ndarray, "n 4 4"], focus: Float[np.ndarray, "3"], frames: int
) -> Float[np.ndarray, "frames 4 4"]:
    """A closed path around a focus, at the height and distance of the given cameras: a full circle if the
    cameras surround the focus, else a swing back and forth within their arc.

    Args:
        viewmats: view matrices of the cameras, world to camera.
        focus: the point that the cameras look at.
        frames: number of view matrices to return.
    """
    rotations = viewmats[:, :3, :3]
    offsets = -np.einsum("nji,nj->ni", rotations, viewmats[:, :3, 3]) - focus
    up = -rotations[:, 1].mean(0)
    if np.linalg.norm(up) < 1e-6:  # as many cameras upside down as upright
        up = -rotations[0, 1]
    up /= np.linalg.norm(up)
    side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    x, y, heights = offsets @ side, offsets @ ahead, offsets @ up
    far = float(np.median(np.linalg.norm(offsets, axis=1)))
    radius = max(float(np.median(np.hypot(x, y))), _NEAREST * far, 1e-6)
    turn = np.arange(frames) / frames * 2 * np.pi
    angles, is_ring = _angles(np.sort(np.arctan2(y, x)), turn)
    low, high = np.percentile(heights, [25, 75])
    levels = (low + high) / 2 + (0 if is_ring else (high - low) / 2) * np.sin(turn)
    eyes = focus + radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * ahead)
    eyes += levels[:, None] * up
    return np.stack([look_at(eye, focus, up) for eye in eyes])


def _angles(at: Float[np.ndarray, "n"], turn: Float[np.ndarray, "frames"]):
    """Angle of each frame on the circle, and whether the path goes all the way around."""
    gaps = np.diff(np.append(at, at[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < _WIDEST_GAP:
        return at[0] + turn, True
    begin = at[(widest + 1) % len(at)]
    half = (2 * np.pi - gaps[widest]) / 2
    return begin + half + max(0.8 * half, _SWING) * np.sin(turn), False
