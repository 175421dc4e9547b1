"""Initial Gaussians of a deforming scene, from the depth of all frames or on a plane. On the host."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import pixels_of
from gsjax.geometry.neighbors import voxel_thin
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.initialize import gaussians_from_points, points_from_rgbd

_BEHIND = 0.06  # relative depth behind a surface beyond which a point was occluded rather than moved there
_NEAR_PX = 2.0  # a point of another frame nearer than this to the points so far adds nothing


def start_gaussians(frames: Sequence[Frame], first: int, pixels: float) -> Gaussians:
    """Gaussians on the surfaces that the first frame shows, and, from the other frames, on those that it does
    not: masked out, occluded, or outside the image.

    A point of another frame is new if it projects to a pixel of the first frame without known depth, or lies
    far behind that depth, and no earlier point lies within two pixels of it. So surfaces that have moved are
    not duplicated.

    Args:
        frames: frames of one camera over time; pixels outside their masks do not count.
        first: index of the frame that the canonical scene is initialised from.
        pixels: edge of the cubes in which points are thinned to one Gaussian, in pixels.

    Raises:
        ValueError: no frame has depth where a pixel counts.
    """
    order = [first, *(i for i in range(len(frames)) if i != first)]
    of_first = known_depth(frames[first])
    points, colors = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    pixel = 0.0  # its width at the median depth, metres
    for i in order:
        frame = frames[i]
        known, viewmat, K = known_depth(frame), frame.cameras.viewmat[0], frame.cameras.K[0]
        if not known.any():
            continue
        if pixel == 0.0:
            pixel = float(np.median(known[known > 0])) / K[0, 0]
        some, shades = points_from_rgbd(frame.images[0], known, viewmat, K)
        if len(points):
            new = _unseen(some, frames[first], of_first)
            apart, _ = cKDTree(points).query(some, distance_upper_bound=_NEAR_PX * pixel)
            new &= ~np.isfinite(apart)
            some, shades = some[new], shades[new]
        kept = voxel_thin(some.astype(np.float64), pixels * pixel)
        points, colors = np.concatenate([points, some[kept]]), np.concatenate([colors, shades[kept]])
    if not len(points):
        raise ValueError(
            "depth: no frame has any where a pixel counts; are masks inverted, or are all depths 0?"
        )
    return gaussians_from_points(points, colors)


def can_start_from(frame: Frame, frames: Sequence[Frame]) -> bool:
    """Whether a scene can be initialised from a frame: a pixel counts, and has depth if any frame does."""
    if all(one.depths is None for one in frames):
        return frame.masks is None or bool(frame.masks.any())
    return bool(known_depth(frame).any())


def with_plane_depths(frames: Sequence[Frame], first: int, depth: float) -> list[Frame]:
    """The frames with the depths of a plane parallel to the image of the first one, to initialize a scene of
    unknown depth.

    Args:
        frames: frames of one camera over time.
        first: index of the frame that faces the plane.
        depth: distance of the plane from that camera, in the unit of the poses.
    """
    facing = frames[first].cameras.viewmat[0]
    normal = facing[2, :3]  # n . x = offset in the world
    offset = depth - facing[2, 3]

    def of_plane(frame: Frame) -> Frame:
        camera = frame.cameras
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(camera.K[0]).T
        rotation, shift = camera.viewmat[0, :3, :3], camera.viewmat[0, :3, 3]
        towards = rays @ (rotation @ normal)  # approach to the plane per unit of depth
        away = offset + (rotation.T @ shift) @ normal
        reached = np.where(np.abs(towards) > 1e-6, away / np.where(towards == 0, 1.0, towards), 0.0)
        depths = np.maximum(reached, 0.0).astype(np.float32)[None]
        return eqx.tree_at(lambda f: f.depths, frame, depths, is_leaf=lambda leaf: leaf is None)

    return [of_plane(frame) for frame in frames]


def known_depth(frame: Frame) -> Float[np.ndarray, "h w"]:
    """Depths of a frame of one camera where they are known and count, else 0, metres."""
    return frame.known_depths[0].astype(np.float32)


def _unseen(
    points: Float[np.ndarray, "n 3"], frame: Frame, known: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "n"]:
    """Which points project outside the frame or to a pixel without known depth, or lie far behind it."""
    camera = frame.cameras
    at = pixels_of(points, camera.viewmat[0], camera.K[0], camera.width, camera.height)
    before = known[at.rows, at.columns]
    return ~at.inside | (before == 0) | (at.depths > (1 + _BEHIND) * before)
