"""Object labels of the points of an initial scene, from one view's mask. All on the host."""

import warnings

import numpy as np
from jaxtyping import Float, Int, Integer, Num
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import project
from gsjax.geometry.neighbors import valid_depth
from gsjax.scene.initialize import check_depth, on_host

UNKNOWN_LABEL = -1
BACKGROUND_LABEL = 0
_NEIGHBORS = 8
# A crease of 90 degrees, where a box stands on a table, counts as 16 cm along the surface.
_METRES_PER_CONCAVE_RADIAN = 0.1


def lift_labels(
    points: Float[np.ndarray, "N 3"],
    mask: Integer[np.ndarray, "mask_H mask_W"],
    depth: Num[np.ndarray, "H W"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    max_depth_gap: float = 0.015,
) -> Int[np.ndarray, "N"]:
    """Labels of the points that one view sees, from its mask; -1 for the others.

    A point is seen if its projection lies in the image and its z is within `max_depth_gap` metres of the
    depth there, so an object in front does not label what is behind it.

    Args:
        points: points in the world, metres.
        mask: integer labels, 0 the background.
        depth: z-depth in metres; invalid values are 0, negative or not finite.
        viewmat: world to camera.
        K: intrinsics, pixels.
        max_depth_gap: largest difference between a point's z and the depth of its pixel, metres.

    Raises:
        ValueError: mask and depth differ in size, or no pixel has depth, so that nothing can be lifted.
    """
    mask, depth, points = np.asarray(mask), np.asarray(depth), np.asarray(points, np.float64)
    check_depth(depth)
    if mask.shape != depth.shape:
        raise ValueError(f"mask: expected shape {depth.shape} to match depth, found {mask.shape}")
    if not valid_depth(depth).any():
        raise ValueError("depth: no pixel is positive and finite, so no label can be lifted from this view")
    height, width = depth.shape
    pixels, z = on_host(project, points, viewmat, K)
    columns, rows = np.floor(pixels.clip(-1, max(width, height))).astype(int).T
    inside = (z > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
    there = depth[rows, columns]
    seen = inside & valid_depth(there) & (np.abs(there - z) <= max_depth_gap)
    # Widened first: -1 in an array of bytes, as mask files give, would become 255.
    labels = np.where(seen, mask[rows, columns].astype(np.int32), UNKNOWN_LABEL)
    _warn_of_lost_labels(mask, labels)
    return labels


def inherit_labels(
    points: Float[np.ndarray, "N 3"],
    labels: Integer[np.ndarray, "labels"],
    normals: Float[np.ndarray, "normals 3"],
    *,
    max_distance: float = 0.15,
    max_step: float = 0.02,
) -> Int[np.ndarray, "N"]:
    """Labels in which each unknown (-1) point takes that of the known point nearest to it along the surface.

    Paths run from neighbour to neighbour, and turning into a concave crease counts as a long distance:
    objects are mostly convex, and separate objects mostly meet in a crease (the criterion of Stein et al.,
    "Object Partitioning using Local Convexity", CVPR 2014). So the far side of a box takes the box's label
    over its edge, not that of the table it stands on. Points that no path reaches become background, 0:
    without a limit on paths, labels would bleed into what the view could not see.

    Args:
        points: metres.
        labels: label of each point, -1 where unknown.
        normals: unit normals, pointing outward, towards the camera that saw the point.
        max_distance: longest path, metres.
        max_step: points farther apart than this do not share a surface, metres.

    Raises:
        ValueError: there is not exactly one label or normal per point.
    """
    points, labels, normals = np.asarray(points, np.float64), np.asarray(labels), np.asarray(normals)
    if labels.shape != points.shape[:1]:
        raise ValueError(f"labels: expected shape [{len(points)}] to match points, found {labels.shape}")
    if normals.shape != points.shape:
        raise ValueError(f"normals: expected shape {points.shape} to match points, found {normals.shape}")
    known = labels != UNKNOWN_LABEL
    inherited = np.where(known, labels, BACKGROUND_LABEL).astype(np.int32)
    begins, ends = _neighbor_pairs(points, max_step)
    # Known points matter only where they border on unknown ones; the graph is reduced to those.
    border = np.unique(
        np.concatenate([begins[known[begins] & ~known[ends]], ends[known[ends] & ~known[begins]]])
    )
    if len(border) == 0:
        return inherited
    nodes = np.union1d(np.flatnonzero(~known), border)
    place = np.full(len(points), -1)
    place[nodes] = np.arange(len(nodes))
    inner = (place[begins] >= 0) & (place[ends] >= 0)
    begins, ends = begins[inner], ends[inner]
    lengths = _path_lengths(points, normals, begins, ends)
    graph = csr_matrix((lengths, (place[begins], place[ends])), shape=(len(nodes),) * 2)
    distance, _, source = dijkstra(
        graph,
        directed=False,
        indices=place[border],
        min_only=True,
        return_predecessors=True,
        limit=max_distance,
    )
    reached = np.isfinite(distance) & ~known[nodes]
    inherited[nodes[reached]] = labels[nodes[source[reached]]]
    return inherited


def _neighbor_pairs(points: np.ndarray, max_step: float) -> tuple[np.ndarray, np.ndarray]:
    """Indices of neighbouring points: for each pair, the point and one of its nearest neighbours."""
    if len(points) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    count = min(_NEIGHBORS + 1, len(points))
    distances, indices = cKDTree(points).query(points, k=count, distance_upper_bound=max_step)
    near = np.isfinite(distances) & (indices != np.arange(len(points))[:, None])
    rows, columns = np.nonzero(near)
    return rows, indices[rows, columns]


def _path_lengths(points, normals, begins, ends) -> np.ndarray:
    """Length of each step, plus a cost for its bend if concave: normals then lean towards each other."""
    along = points[begins] - points[ends]
    before, after = normals[begins], normals[ends]
    turn = np.arccos(np.clip(np.sum(before * after, axis=1), -1, 1))
    concave = np.sum((before - after) * along, axis=1) < 0
    length = np.linalg.norm(along, axis=1) + _METRES_PER_CONCAVE_RADIAN * turn * concave
    return np.maximum(length, 1e-9)  # a sparse graph treats 0 as "no edge"


def _warn_of_lost_labels(mask: np.ndarray, labels: np.ndarray) -> None:
    """Warn about labels that have pixels but reached no point."""
    lost = sorted({*np.unique(mask).tolist()} - {BACKGROUND_LABEL, *np.unique(labels).tolist()})
    if lost:
        warnings.warn(f"mask: label {lost} reached no point (no depth there, or no points)", stacklevel=3)
