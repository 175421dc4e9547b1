"""The first Gaussians of a deforming scene: depth of what no tool hides, over time. On the host."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import NEAR
from gsjax.geometry.neighbors import voxel_thin
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd


class Look(NamedTuple):
    """What a camera saw at a time, on the host.

    Attributes:
        image: RGB.
        counts: which pixels are to be reconstructed, the tools left out say; None for all.
        depth: metres, 0 where unknown; None without.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics in pixels.
        time: 0 to 1 over the recording.
        ids: which row of the teacher's codebook each pixel has, -1 for none; of any size. None without
            teacher.
        near: what is nearer is not drawn, metres.
    """

    image: UInt8[np.ndarray, "h w 3"]
    counts: Bool[np.ndarray, "h w"] | None
    depth: Float[np.ndarray, "h w"] | None
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    time: float
    ids: Int[np.ndarray, "h_ w_"] | None = None
    near: float = NEAR


def start_gaussians(looks: Sequence[Look], first: int, pixels: float) -> Gaussians:
    """Gaussians on what the first look shows, and, from the other looks, on what it does not: there lay a
    tool, or it lay outside.

    A point of a later look is new if it falls where the first look shows nothing, and none of those before
    lies within two pixels of it; so what has moved in the meantime is not doubled.

    Args:
        looks: over time.
        first: which of them the canonical scene is like.
        pixels: edge of the cubes that are thinned to one Gaussian, in pixels.

    Raises:
        ValueError: no look has depth where a pixel counts.
    """
    order = [first, *(i for i in range(len(looks)) if i != first)]
    points, colors = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    pixel = 0.0
    for i in order:
        look = looks[i]
        known = known_depth(look)
        if not known.any():
            continue
        if pixel == 0.0:
            pixel = float(np.median(known[known > 0])) / look.K[0, 0]
        some, shades = points_from_rgbd(look.image, known, look.viewmat, look.K)
        if len(points):
            new = _in_other_pixels(some, looks[first])
            apart, _ = cKDTree(points).query(some, distance_upper_bound=_NEAR_PX * pixel)
            new &= ~np.isfinite(apart)
            some, shades = some[new], shades[new]
        kept = voxel_thin(some.astype(np.float64), pixels * pixel)
        points, colors = np.concatenate([points, some[kept]]), np.concatenate([colors, shades[kept]])
    if not len(points):
        raise ValueError(
            "depth: no look has any where a pixel counts; are masks inverted, or is depth all 0?"
        )
    return gaussians_from_points(points, colors)


_NEAR_PX = 2.0


def _in_other_pixels(points: Float[np.ndarray, "n 3"], look: Look) -> Bool[np.ndarray, "n"]:
    """Which points fall outside of a look, or where it does not count or has no depth."""
    known = known_depth(look) > 0
    height, width = known.shape
    local = points @ look.viewmat[:3, :3].T + look.viewmat[:3, 3]
    ahead = np.where(local[:, 2] > 0, local[:, 2], np.inf)
    x, y = ((local @ look.K.T)[:, :2] / ahead[:, None]).T
    inside = np.isfinite(ahead) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column, row = (np.where(inside, np.floor(a), 0).astype(int) for a in (x, y))
    return ~inside | ~known[row, column]


def known_depth(look: Look) -> Float[np.ndarray, "h w"]:
    """Depth where it is known and counts, else 0."""
    if look.depth is None:
        return np.zeros(look.image.shape[:2], np.float32)
    known = np.isfinite(look.depth) & (look.depth > 0)
    return np.where(known if look.counts is None else known & look.counts, look.depth, 0).astype(np.float32)
