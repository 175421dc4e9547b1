"""Helpers for tests of simulated scenes: projection and interpolation."""

import numpy as np
from scipy.ndimage import map_coordinates


def project_points(sequence, t, c, points):
    """Pixels (x, y) and depths of world points [V,3] in camera c."""
    view, K = sequence.viewmats[t, c], sequence.Ks[t, c]
    local = points @ view[:3, :3].T + view[:3, 3]
    pixels = local @ K.T
    return pixels[:, :2] / pixels[:, 2:], local[:, 2]


def interpolate(image, pixels):
    """Values of an image at pixels (x, y), bilinearly interpolated."""
    return map_coordinates(image.astype(np.float64), (pixels - 0.5).T[::-1], order=1, mode="nearest")


def depths_from_another_frame(sequence, t, u):
    """Depths measured by camera 0 in frame u, and those expected there for the points measured in frame t."""
    depth, K = sequence.depth(t, 0), sequence.Ks[t, 0]
    y, x = np.nonzero(depth)
    local = np.linalg.inv(K) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) * depth[y, x]
    moved = sequence.viewmats[u, 0] @ np.linalg.inv(sequence.viewmats[t, 0])
    there = moved[:3, :3] @ local + moved[:3, 3:]
    x, y = np.floor((K @ there)[:2] / there[2]).astype(int)
    inside = (x >= 0) & (x < sequence.width) & (y >= 0) & (y < sequence.height)
    return sequence.depth(u, 0)[y[inside], x[inside]], there[2][inside]
