"""Surfaces that depth cameras measure, as points, and what cameras tell about a point: they see a surface
there, or see through it."""

from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import project
from gsjax.geometry.neighbors import voxel_thin
from gsjax.optim.compiler import host_jit
from gsjax.scene.frame import Frame

_NOISE_SCALE = 1.65  # median of absolute second differences of white noise, in standard deviations
_LEAST_NOISE, _MOST_NOISE = 5e-4, 4.0  # of depth, relative; differences up to so many deviations are noise
_WIDTH = 3.0  # of the filter, pixels
_FAR_AWAY = 20.0  # how far unknown depth is put behind all other, in largest differences of noise
_LEAST_FACING = 0.25  # cosine between line of sight and normal below which a normal is poorly known
_STEEPEST = 6.0  # pixels between the points of neighbouring pixels above which there is an edge
_FACES = 0.2  # cosine between line of sight and normal below which a camera does not judge a point
_APART = 0.5  # spacings by which the two sides of a thin plate are kept apart
_AROUND, _WITHIN = 24, 3.0  # neighbours of a point, and their largest distance, in spacings
_FLAT = 0.8  # cosine between the normals of points on one side of an edge
_STIFF = 0.01  # regularisation of the slope of brightness, relative to points a spacing away
_ONE_SIDED = 0.3  # mean offset of neighbours at an edge, relative to the farthest; 0.42 at a straight edge
_ROOM = 4096  # points are padded to multiples of it, so that few shapes are compiled


class Surface(NamedTuple):
    """Points on surfaces.

    Attributes:
        points: metres, world.
        normals: of length 1, towards the cameras.
        colors: 0 to 1.
        outward: at an edge, the direction along the surface that leaves it, of length 1; 0 elsewhere.
        brightness: 0 to 1, smooth.
        slope: of the brightness along the surface, 1/m.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]
    outward: Float[np.ndarray, "n 3"]
    brightness: Float[np.ndarray, "n"]
    slope: Float[np.ndarray, "n 3"]

    def of(self, rows: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "Surface":
        """The surface with some of its points."""
        return Surface(*(values[rows] for values in self))


class Evidence(NamedTuple):
    """What cameras tell about each of n points.

    Attributes:
        there: number of cameras that see a surface there.
        through: number of cameras that see something behind it.
    """

    there: Float[np.ndarray, "n"]
    through: Float[np.ndarray, "n"]

    @property
    def share(self) -> Float[np.ndarray, "n"]:
        """Of the cameras that see the place of a point, the share that sees through it; 0 if none sees it."""
        return self.through / np.maximum(self.there + self.through, 1)

    @property
    def seen(self) -> Bool[np.ndarray, "n"]:
        """Points whose place some camera sees."""
        return self.there + self.through > 0


def color_distance(
    one: Float[np.ndarray, "*n 3"], other: Float[np.ndarray, "*m 3"]
) -> Float[np.ndarray, "*m"]:
    """Mean absolute difference of colours, 0 to 1."""
    return np.abs(one - other).mean(-1)


def pixel_width(frame: Frame) -> float:
    """Width of a pixel at the depth of the visible surfaces, metres; the median over the cameras.

    Args:
        frame: all cameras, with depth.
    """
    depths, focal = np.asarray(frame.depths), np.asarray(frame.cameras.K)[:, 0, 0]
    widths = [np.median(depth[depth > 0]) / f for depth, f in zip(depths, focal, strict=True) if depth.any()]
    return float(np.median(widths))


def denoised(frame: Frame) -> Frame:
    """The frame with less noise in its depth: if noise is measurable, depth is averaged with the depth around
    it that differs by no more than noise does (a bilateral filter).

    Args:
        frame: all cameras, with depth, 0 where unknown.
    """
    depths = np.asarray(frame.depths, np.float32)
    logs = np.log(np.where(depths > 0, depths, np.nan))
    bends = np.abs(logs[:, :, 2:] - 2 * logs[:, :, 1:-1] + logs[:, :, :-2])
    noise = float(np.nanmedian(bends)) / _NOISE_SCALE if np.isfinite(bends).any() else 0.0
    if noise < _LEAST_NOISE:
        return frame
    width = _MOST_NOISE * noise
    apart = np.where(np.isfinite(logs), logs, np.nanmax(logs) + _FAR_AWAY * width)
    smooth = np.stack([cv2.bilateralFilter(one, -1, width, _WIDTH) for one in apart.astype(np.float32)])
    return eqx.tree_at(lambda f: f.depths, frame, jnp.asarray(np.where(depths > 0, np.exp(smooth), 0)))


def surface_of(frame: Frame, spacing: float) -> Surface:
    """The surfaces that all cameras see, thinned to about one point in `spacing`.

    Args:
        frame: all cameras, with depth, 0 where unknown.
        spacing: metres.
    """
    colors, cameras, seen = np.asarray(frame.colors), frame.cameras, []
    views = zip(
        np.asarray(frame.depths), np.asarray(cameras.viewmat), np.asarray(cameras.K), colors, strict=True
    )
    for depth, viewmat, K, picture in views:
        rows, columns = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
        rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], -1)
        local = rays * np.where(depth > 0, depth, np.nan)[..., None]
        across, down = local[1:-1, 2:] - local[1:-1, :-2], local[2:, 1:-1] - local[:-2, 1:-1]
        local, picture = local[1:-1, 1:-1], picture[1:-1, 1:-1]
        normals = np.cross(down, across)  # towards the camera
        with np.errstate(invalid="ignore", divide="ignore"):
            normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
            facing = -(normals * local).sum(-1) / np.linalg.norm(local, axis=-1)
            longest = np.maximum(np.linalg.norm(across, axis=-1), np.linalg.norm(down, axis=-1))
            known = (facing > _LEAST_FACING) & (longest < _STEEPEST * local[..., 2] / K[0, 0])
        rotation, shift = viewmat[:3, :3], viewmat[:3, 3]
        seen.append(((local[known] - shift) @ rotation, normals[known] @ rotation, picture[known]))
    points, normals, colors = (np.concatenate(values) for values in zip(*seen, strict=True))
    rows = voxel_thin(points + _APART * spacing * normals, spacing)
    points, normals = points[rows], normals[rows]
    return Surface(points, normals, colors[rows], *around(points, normals, colors[rows], spacing))


def around(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    colors: Float[np.ndarray, "n 3"],
    spacing: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]:
    """What the neighbours of each point tell: `Surface.outward`, `brightness` and `slope`.

    Args:
        points, normals, colors: those of the surface.
        spacing: distance between the points, metres.
    """
    if not len(points):
        return points, np.zeros(0), points
    count = max(min(_AROUND, len(points)), 2)
    near = cKDTree(points).query(points, k=count, distance_upper_bound=_WITHIN * spacing)[1]
    known = near < len(points)
    near = np.where(known, near, 0)
    known &= np.einsum("nkd,nd->nk", normals[near], normals) > _FLAT
    counts = np.maximum(known.sum(1), 1)
    offsets = (points[near] - points[:, None]) * known[..., None]
    offsets -= np.einsum("nkd,nd->nk", offsets, normals)[..., None] * normals[:, None]
    mean = offsets.sum(1) / counts[:, None]
    length = np.linalg.norm(mean, axis=-1)
    ends = length > _ONE_SIDED * np.linalg.norm(offsets, axis=-1).max(1)
    outward = np.where(ends[:, None], -mean / np.maximum(length, 1e-12)[:, None], 0)
    brightness = colors.mean(-1)
    values = np.where(known, brightness[near], 0)
    level = values.sum(1) / counts
    spread = np.einsum("nki,nkj->nij", offsets, offsets) - counts[:, None, None] * np.einsum(
        "ni,nj->nij", mean, mean
    )
    spread += _STIFF * counts[:, None, None] * spacing**2 * np.eye(3)
    moment = np.einsum("nkd,nk->nd", offsets, values) - (counts * level)[:, None] * mean
    slope = np.linalg.solve(spread, moment[..., None])[..., 0]
    return outward, np.clip(level - (slope * mean).sum(-1), 0, 1), slope


def evidence(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    frame: Frame,
    tolerance: float,
) -> Evidence:
    """What the cameras of a frame tell about points. Any of the 3 x 3 pixels around a projection may show it.

    Args:
        points: metres, world.
        normals: normals of the points; a camera judges only points that face it. None: it judges all.
        frame: all cameras, with depth, 0 where unknown.
        tolerance: difference in depth that counts as the same, metres.
    """
    size = -(-len(points) // _ROOM) * _ROOM
    room = ((0, size - len(points)), (0, 0))
    given = [None if a is None else np.pad(a, room).astype(np.float32) for a in (points, normals)]
    counts = _evidence(*given, frame.depths, frame.cameras.viewmat, frame.cameras.K, jnp.float32(tolerance))
    return Evidence(*(np.asarray(count)[: len(points)] for count in counts))


@host_jit
def _evidence(
    points, normals, depths, viewmats, Ks, tolerance
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    height, width = depths.shape[1:]

    def of_camera(counts, camera):
        depth, viewmat, K = camera
        pixels, z = project(points, viewmat, K)
        column, row = jnp.floor(pixels).astype(jnp.int32).T
        judged = (z > 1e-3) & (column > 0) & (column < width - 1) & (row > 0) & (row < height - 1)
        if normals is not None:
            sights = points @ viewmat[:3, :3].T + viewmat[:3, 3]
            facing = -jnp.sum((normals @ viewmat[:3, :3].T) * sights, axis=-1)
            judged &= facing > _FACES * jnp.linalg.norm(sights, axis=-1)
        column, row = jnp.clip(column, 1, width - 2), jnp.clip(row, 1, height - 2)
        around = [depth[row + down, column + right] for down in (-1, 0, 1) for right in (-1, 0, 1)]
        there = jnp.stack([jnp.abs(one - z) < tolerance for one in around]).any(0)
        nearest = jnp.stack(around).min(0)  # 0 where any is unknown
        seen = judged & there, judged & (nearest > z + tolerance)
        return jax.tree.map(jnp.add, counts, seen), None

    none = jnp.zeros(len(points))
    return jax.lax.scan(of_camera, (none, none), (depths, viewmats, Ks))[0]
