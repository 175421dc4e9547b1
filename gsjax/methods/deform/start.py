"""The first Gaussians of a deforming scene: depth over time where no tool is, or a plane. On the host."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import NEAR, pixels_of
from gsjax.geometry.neighbors import voxel_thin
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd

_BEHIND = 0.06  # of the depth: farther behind what is seen lies what that hides, not what has moved
_NEAR_PX = 2.0  # nearer than this to a Gaussian that is there, a point of another look is none of its own


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
    tool that is left out, it lay behind something, or outside.

    A point of another look is new if it falls where the first look shows nothing, or far behind what it
    shows, and none of those before lies within two pixels of it; so what has moved in the meantime is not
    doubled.

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
            new = _unseen(some, looks[first])
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


def begins(look: Look, looks: Sequence[Look]) -> bool:
    """Whether a scene can begin with one of the looks: something counts, and has depth where any has."""
    if all(one.depth is None for one in looks):
        return look.counts is None or bool(look.counts.any())
    return bool(known_depth(look).any())


def on_plane(looks: Sequence[Look], first: int, depth: float) -> list[Look]:
    """The looks as if all that they saw were painted on a plane that the first one faces: something to begin
    with where depth is not known.

    Args:
        looks: over time.
        first: which of them faces it.
        depth: how far before it the plane lies, in the unit of the poses.
    """
    facing = looks[first].viewmat
    normal = facing[2, :3]  # n . x = offset in the world
    offset = depth - facing[2, 3]

    def of(look: Look) -> Look:
        height, width = look.image.shape[:2]
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(look.K).T
        rotation, shift = look.viewmat[:3, :3], look.viewmat[:3, 3]
        towards = rays @ (rotation @ normal)  # how much nearer the plane a ray comes a unit of depth
        away = offset + (rotation.T @ shift) @ normal
        reached = np.where(np.abs(towards) > 1e-6, away / np.where(towards == 0, 1.0, towards), 0.0)
        return look._replace(depth=np.maximum(reached, 0.0).astype(np.float32))

    return [of(look) for look in looks]


def _unseen(points: Float[np.ndarray, "n 3"], look: Look) -> Bool[np.ndarray, "n"]:
    """Which points fall outside of a look, where it does not count or has no depth, or far behind that."""
    known = known_depth(look)
    height, width = known.shape
    at = pixels_of(points, look.viewmat, look.K, width, height)
    before = known[at.rows, at.columns]
    return ~at.inside | (before == 0) | (at.depths > (1 + _BEHIND) * before)


def known_depth(look: Look) -> Float[np.ndarray, "h w"]:
    """Depth where it is known and counts, else 0."""
    if look.depth is None:
        return np.zeros(look.image.shape[:2], np.float32)
    known = np.isfinite(look.depth) & (look.depth > 0)
    return np.where(known if look.counts is None else known & look.counts, look.depth, 0).astype(np.float32)
