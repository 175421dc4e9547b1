"""Neighbour queries on the host, for building point sets; nothing here runs inside a jitted step."""

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy.spatial import cKDTree

ENDLESS = 1e6
"""Depth, in any unit, from which on nothing was seen: renderers write 1e10 or more there."""

_AROUND = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]
_SAME_DEPTH = 0.05  # relative: a surface seen at a grazing angle recedes by this from pixel to pixel


def nearest(
    queries: Float[np.ndarray, "m 3"], points: Float[np.ndarray, "n 3"], max_distance: float = np.inf
) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Index of the point nearest to each query, and its distance in metres; -1 and inf if none is in range.

    Args:
        queries: positions, metres.
        points: the points to search, metres.
        max_distance: points farther away than this are ignored, metres.
    """
    if len(points) == 0:
        return np.full(len(queries), -1), np.full(len(queries), np.inf)
    distances, indices = cKDTree(points).query(queries, distance_upper_bound=max_distance)
    return np.where(np.isfinite(distances), indices, -1), distances


def nearest_neighbors(points: Float[np.ndarray, "n 3"], k: int) -> Int[np.ndarray, "n k"]:
    """Indices of the `k` nearest other points of each point, padded with its own index if there are fewer; a
    point that is not finite gets only its own.

    Args:
        points: positions, metres.
        k: number of neighbours.
    """
    found = np.tile(np.arange(len(points))[:, None], (1, k))
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    count = min(k, len(finite) - 1)
    if count < 1:
        return found
    _, nearby = cKDTree(points[finite]).query(points[finite], k=count + 1)
    own = nearby == np.arange(len(finite))[:, None]
    own[~own.any(axis=1), -1] = True  # with many points in one place, a point may not find itself
    found[finite, :count] = finite[nearby[~own].reshape(-1, count)]
    return found


def neighbor_spacing(points: Float[np.ndarray, "n 3"], k: int = 3) -> Float[np.ndarray, "n"]:
    """Root mean square distance to the `k` nearest other points, metres; 3DGS initialises scales with it."""
    k = min(k, len(points) - 1)
    if k < 1:
        return np.full(len(points), 0.01)
    distances, _ = cKDTree(points).query(points, k=k + 1)
    return np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1))


def voxel_thin(points: Float[np.ndarray, "n 3"], voxel: float) -> Int[np.ndarray, "m"]:
    """Indices of one point per cubic voxel of edge `voxel` metres: the one nearest to the voxel's mean."""
    if len(points) == 0 or voxel <= 0:
        return np.arange(len(points))
    cells = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    _, inverse, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    means = np.stack([np.bincount(inverse, points[:, i]) for i in range(3)], axis=1) / counts[:, None]
    distance = np.linalg.norm(points - means[inverse], axis=1)
    order = np.lexsort((distance, inverse))
    first = np.concatenate([[True], np.diff(inverse[order]) > 0])
    return np.sort(order[first])


def valid_depth(depths: Num[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Where depth is known: positive, and less than `ENDLESS`."""
    return (depths > 0) & (depths < ENDLESS)


def drop_flying_pixels(depths: Float[np.ndarray, "*c h w"]) -> Float[np.ndarray, "*c h w"]:
    """Depth of the pixels that lie on a surface, else 0.

    A pixel lies on none if its depth is not known (`valid_depth`), or if it is a flying pixel: five or more
    of its eight neighbours have depth and fewer than two of them agree with it within 5 %, or three or four
    have depth and none agrees. Depth cameras measure flying pixels at edges, in rain and on dark or shiny
    objects. Sparse depth and lines one pixel wide are kept, but depth with more than about 3 % noise is
    thinned.

    Args:
        depths: depth images of any number of cameras, metres.
    """
    known = np.where(valid_depth(depths), depths, 0)
    height, width = known.shape[-2:]
    padded = np.pad(known, [(0, 0)] * (known.ndim - 2) + [(1, 1), (1, 1)])
    around, alike = np.zeros(known.shape, np.int8), np.zeros(known.shape, np.int8)
    for down, right in _AROUND:
        other = padded[..., 1 + down : 1 + down + height, 1 + right : 1 + right + width]
        around += other > 0
        alike += (other > 0) & (np.abs(other - known) <= _SAME_DEPTH * known)
    alone = ((around >= 5) & (alike < 2)) | ((around >= 3) & (alike < 1))
    return np.where(alone, 0, known).astype(depths.dtype)
