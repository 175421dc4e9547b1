"""The surfaces that depth cameras measure, as points, and what cameras say of points: there is a surface, or
they see through."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import project
from gsjax.geometry.neighbors import voxel_thin
from gsjax.optim.compiler import host_jit
from gsjax.scene.frame import Frame

_LEAST_FACING = 0.25  # cosine of the angle of sight below which depth says little of a normal
_STEEPEST = 6.0  # pixels between the points of neighbouring pixels, above which there is an edge
_FACES = 0.2  # cosine of the angle of sight below which a point is not judged
_APART = 0.5  # spacings by which the two sides of a thin plate are kept apart
_ROOM = 4096  # points are judged in multiples of it, so that few shapes are compiled


class Surface(NamedTuple):
    """Points on surfaces.

    Attributes:
        points: metres, world.
        normals: of length 1, towards the cameras.
        colors: 0 to 1.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]

    def of(self, rows: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "Surface":
        """Some of the points."""
        return Surface(*(values[rows] for values in self))


class Evidence(NamedTuple):
    """What cameras say of each of n points.

    Attributes:
        there: number of cameras that see a surface there.
        through: number of cameras that see something behind it.
    """

    there: Float[np.ndarray, "n"]
    through: Float[np.ndarray, "n"]

    @property
    def share(self) -> Float[np.ndarray, "n"]:
        """Share of the cameras that see the place of a point, which see through it; 0 if none does."""
        return self.through / np.maximum(self.there + self.through, 1)

    @property
    def seen(self) -> Bool[np.ndarray, "n"]:
        """Points whose place some camera sees."""
        return self.there + self.through > 0


def unlike(one: Float[np.ndarray, "*n 3"], other: Float[np.ndarray, "*m 3"]) -> Float[np.ndarray, "*m"]:
    """How unlike colours are, 0 to 1."""
    return np.abs(one - other).mean(-1)


def pixel_width(frame: Frame) -> float:
    """Width of a pixel at the depth of what is seen, metres: the median over the cameras.

    Args:
        frame: all cameras, with depth.
    """
    depths, focal = np.asarray(frame.depths), np.asarray(frame.cameras.K)[:, 0, 0]
    widths = [np.median(depth[depth > 0]) / f for depth, f in zip(depths, focal, strict=True) if depth.any()]
    return float(np.median(widths))


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
    surface = Surface(*(np.concatenate(values) for values in zip(*seen, strict=True)))
    return surface.of(voxel_thin(surface.points + _APART * spacing * surface.normals, spacing))


def evidence(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None,
    frame: Frame,
    tolerance: float,
) -> Evidence:
    """What the cameras of a frame say of points. Any of the 3 x 3 pixels around a point's may show it.

    Args:
        points: metres, world.
        normals: of the points, of which only those that face a camera are judged by it; None: all are.
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
