"""A first scene from RGB-D: points, Gaussians on them, labels lifted from one mask. All on the host."""

import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Integer, Num
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import project, unproject
from gsjax.geometry.neighbors import nearest, neighbor_spacing, voxel_thin
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated

UNKNOWN_LABEL = -1
BACKGROUND_LABEL = 0
# A room is metres across: a median depth beyond this is almost surely a millimetre count read as metres.
_SUSPICIOUS_DEPTH = 100.0


def points_from_rgbd(
    image: Num[np.ndarray, "image_H image_W 3"],
    depth: Num[np.ndarray, "H W"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    stride: int = 1,
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]:
    """World points and their colours from every `stride`-th pixel with depth.

    Args:
        image: uint8 0 to 255 or floats 0 to 1.
        depth: z-depth in metres; 0, negative and non-finite values are invalid and dropped.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics in pixels, principal point for pixel centres at +0.5.

    Returns:
        Points in metres and colours 0 to 1, float32. Both are empty, with a warning, if no pixel has depth.

    Raises:
        ValueError: image and depth differ in size, or depth holds integers (its unit is then unknown).
    """
    image, depth = np.asarray(image), np.asarray(depth)
    _check_depth(depth)
    if image.shape != (*depth.shape, 3):
        raise ValueError(f"image: got shape {image.shape}, want {(*depth.shape, 3)} to match depth")
    if stride < 1:
        raise ValueError(f"stride: got {stride}, want 1 or more")
    rows, columns = np.mgrid[0 : depth.shape[0] : stride, 0 : depth.shape[1] : stride]
    sampled = depth[rows, columns]
    valid = _valid_depth(sampled)
    if not valid.any():
        warnings.warn("depth: no pixel is positive and finite, so this picture gives no points", stacklevel=2)
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    if np.median(sampled[valid]) > _SUSPICIOUS_DEPTH:
        warnings.warn(
            f"depth: the median is {np.median(sampled[valid]):.0f} m; are these millimetres? Want metres",
            stacklevel=2,
        )
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float64)
    safe = np.where(valid, sampled, 1.0).astype(np.float64)
    points = _on_host(unproject, pixels, safe, viewmat, K)
    colors = image[rows, columns][valid]
    colors = colors / 255.0 if np.issubdtype(colors.dtype, np.integer) else colors
    return points[valid].astype(np.float32), np.clip(np.nan_to_num(colors), 0, 1).astype(np.float32)


def estimate_normals(points: Float[np.ndarray, "N 3"], *, neighbors: int = 12) -> Float[np.ndarray, "N 3"]:
    """Unit normals, of either sign: the direction in which the nearest `neighbors` points spread least."""
    points = np.asarray(points, np.float64)
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    _, indices = cKDTree(points).query(points, k=min(neighbors, len(points)))
    around = points[indices] - points[indices].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
    return vectors[:, :, 0]


def quats_from_normals(normals: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions wxyz that turn the z axis onto `normals`; a normal of no length gives the identity."""
    normals = np.asarray(normals, np.float64)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])
    normals = np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), up)
    # An axis and its opposite are one disc; the upper one keeps away from the half turn, whose axis is free.
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    half = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    return half / np.linalg.norm(half, axis=1, keepdims=True)


def spacing_scales(
    points: Float[np.ndarray, "N 3"], *, clip_quantile: float = 0.95
) -> Float[np.ndarray, "N"]:
    """Neighbour spacing in metres, without outliers: capped at its `clip_quantile`, so that a lone point
    gets no giant, and kept above a thousandth of that, so that coinciding points keep some extent."""
    spacing = neighbor_spacing(np.asarray(points, np.float64))
    # "lower" takes a value that occurs: between few points, interpolation would let the outlier through.
    cap = max(float(np.quantile(spacing, clip_quantile, method="lower")), 1e-6)
    return np.clip(spacing, 1e-3 * cap, cap)


def gaussians_from_points(
    points: Float[np.ndarray, "M 3"],
    colors: Float[np.ndarray, "colors 3"],
    *,
    voxel: float = 0.0,
    opacity: float = 0.9,
    scale_factor: float = 0.55,
    clip_quantile: float = 0.95,
    normals: Float[np.ndarray, "normals 3"] | str | None = None,
    flatness: float = 0.2,
) -> Gaussians:
    """A dense cloud of Gaussians, one a voxel, sized by the spacing of their neighbours.

    Args:
        points: metres; rows that are not finite are dropped.
        colors: RGB 0 to 1.
        voxel: edge of the cubes of which each keeps one point, metres; 0 keeps all.
        opacity: of all, 0 to 1.
        scale_factor: standard deviation over neighbour spacing.
        clip_quantile: spacings above this quantile are cut down to it.
        normals: None for spheres; "pca" for discs along the neighbours' plane; or an array of normals.
        flatness: a disc's standard deviation along its normal over that in its plane.

    Raises:
        ValueError: no finite point is given, or a shape or option does not fit.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: got shape {points.shape}, want [M, 3]")
    if colors.shape != points.shape:
        raise ValueError(f"colors: got shape {colors.shape}, want {points.shape} to match points")
    if isinstance(normals, str) and normals != "pca":
        raise ValueError(f"normals: got {normals!r}, want None, 'pca' or an array {points.shape}")
    if normals is not None and not isinstance(normals, str) and np.shape(normals) != points.shape:
        raise ValueError(f"normals: got shape {np.shape(normals)}, want {points.shape} to match points")
    finite = np.flatnonzero(np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1))
    if len(finite) == 0:
        raise ValueError(f"points: none of the {len(points)} is finite; is there any valid depth?")
    kept = finite[voxel_thin(points[finite].astype(np.float64), voxel)]
    points, colors = points[kept], colors[kept]
    scales = np.repeat(scale_factor * spacing_scales(points, clip_quantile=clip_quantile)[:, None], 3, axis=1)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    if normals is not None:
        chosen = estimate_normals(points) if isinstance(normals, str) else np.asarray(normals)[kept]
        quats = quats_from_normals(chosen)
        scales[:, 2] *= flatness
    return gaussians_from_activated(points, quats, scales, np.full(len(points), opacity), colors)


def lift_labels(
    points: Float[np.ndarray, "N 3"],
    mask: Integer[np.ndarray, "mask_H mask_W"],
    depth: Num[np.ndarray, "H W"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    max_depth_gap: float = 0.015,
    expected_labels: Sequence[int] = (),
) -> Int[np.ndarray, "N"]:
    """Labels of the points that one view sees, from its mask; -1 for the others.

    A point is seen where its projection falls in the picture and its z is within `max_depth_gap` metres of
    the depth there, so what stands in front gives its label to nothing behind it.

    Args:
        mask: integer labels, 0 the background.
        expected_labels: labels that must be in the mask; one that no pixel has gives a warning.

    Raises:
        ValueError: mask and depth differ in size, or no pixel has depth, so that nothing can be lifted.
    """
    mask, depth, points = np.asarray(mask), np.asarray(depth), np.asarray(points, np.float64)
    _check_depth(depth)
    if mask.shape != depth.shape:
        raise ValueError(f"mask: got shape {mask.shape}, want {depth.shape} to match depth")
    if not _valid_depth(depth).any():
        raise ValueError("depth: no pixel is positive and finite, so no label can be lifted from this view")
    height, width = depth.shape
    pixels, z = _on_host(project, points, viewmat, K)
    columns, rows = np.floor(pixels.clip(-1, max(width, height))).astype(int).T
    inside = (z > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
    there = depth[rows, columns]
    seen = inside & _valid_depth(there) & (np.abs(there - z) <= max_depth_gap)
    # Widened before: -1 among the bytes of a mask file would become 255.
    labels = np.where(seen, mask[rows, columns].astype(np.int32), UNKNOWN_LABEL)
    _warn_of_lost_labels(mask, labels, expected_labels)
    return labels


def inherit_labels(
    points: Float[np.ndarray, "N 3"], labels: Integer[np.ndarray, "labels"], *, max_distance: float = 0.03
) -> Int[np.ndarray, "N"]:
    """Labels in which each unknown (-1) point has that of the nearest known one within `max_distance` metres.

    What is further away becomes background, 0: without a limit labels bleed into what the view could not see.
    """
    points, labels = np.asarray(points, np.float64), np.asarray(labels)
    if labels.shape != points.shape[:1]:
        raise ValueError(f"labels: got shape {labels.shape}, want [{len(points)}] to match points")
    known = np.flatnonzero(labels != UNKNOWN_LABEL)
    unknown = np.flatnonzero(labels == UNKNOWN_LABEL)
    index, _ = nearest(points[unknown], points[known], max_distance)
    inherited = labels.astype(np.int32)
    inherited[unknown] = BACKGROUND_LABEL
    inherited[unknown[index >= 0]] = labels[known[index[index >= 0]]]
    return inherited


def _warn_of_lost_labels(mask: np.ndarray, labels: np.ndarray, expected: Sequence[int]) -> None:
    """Warn of labels that no pixel has and of labels that have pixels but reached no point."""
    present = set(np.unique(mask).tolist())
    absent = sorted(set(expected) - present)
    if absent:
        warnings.warn(f"mask: no pixel has label {absent}; it holds {sorted(present)}", stacklevel=3)
    lost = sorted(present - {BACKGROUND_LABEL} - set(np.unique(labels).tolist()))
    if lost:
        warnings.warn(f"mask: label {lost} reached no point (no depth there, or no points)", stacklevel=3)


def _check_depth(depth: np.ndarray) -> None:
    if depth.ndim != 2:
        raise ValueError(f"depth: got shape {depth.shape}, want [H, W]")
    if not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(f"depth: got dtype {depth.dtype}, want metres as floats (times the file's unit)")


def _valid_depth(depth: np.ndarray) -> np.ndarray:
    return np.isfinite(depth) & (depth > 0)


def _on_host(function, *arrays):
    """`function` of geometry.cameras on numpy arrays, its results as numpy arrays in JAX's precision."""
    return jax.tree.map(np.asarray, function(*(jnp.asarray(array, float) for array in arrays)))
