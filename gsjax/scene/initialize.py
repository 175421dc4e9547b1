"""An initial scene from RGB-D: points, and Gaussians on them. All on the host."""

import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import unproject
from gsjax.geometry.neighbors import neighbor_spacing, valid_depth, voxel_thin
from gsjax.geometry.sight import rays
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated

# Rooms are metres across: a median depth beyond this is almost certainly in millimetres, not metres.
_SUSPICIOUS_DEPTH = 100.0
_HIDDEN = 0.5  # share of points before the near plane above which something is wrong


def points_from_rgbd(
    image: Num[np.ndarray, "image_H image_W 3"],
    depth: Num[np.ndarray, "H W"],
    viewmat: Float[np.ndarray, "4 4"],
    K: Float[np.ndarray, "3 3"],
    *,
    fisheye: Float[np.ndarray, "4"] | None = None,
    stride: int = 1,
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 3"]]:
    """World points and their colours from every `stride`-th pixel with depth.

    Args:
        image: uint8 0 to 255 or floats 0 to 1.
        depth: z-depth, or distance from a fisheye, in metres; 0, negative and non-finite values are invalid
            and dropped.
        viewmat: world to camera, OpenCV axes.
        K: intrinsics in pixels, with pixel centres at +0.5.
        fisheye: coefficients of a fisheye; None: a pinhole.
        stride: step between sampled pixels along rows and columns.

    Returns:
        Points in metres and colours 0 to 1, float32. Both are empty, with a warning, if no pixel has depth.

    Raises:
        ValueError: image and depth differ in size, or depth holds integers (its unit is then unknown).
    """
    image, depth = np.asarray(image), np.asarray(depth)
    check_depth(depth)
    if image.shape != (*depth.shape, 3):
        raise ValueError(f"image: expected shape {(*depth.shape, 3)} to match depth, found {image.shape}")
    if stride < 1:
        raise ValueError(f"stride: expected 1 or more, found {stride}")
    rows, columns = np.mgrid[0 : depth.shape[0] : stride, 0 : depth.shape[1] : stride]
    sampled = depth[rows, columns]
    valid = valid_depth(sampled)
    if not valid.any():
        warnings.warn("depth: no pixel is positive and finite, so this image gives no points", stacklevel=2)
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)
    if np.median(sampled[valid]) > _SUSPICIOUS_DEPTH:
        warnings.warn(
            f"depth: the median is {np.median(sampled[valid]):.0f} m; are these millimetres? Expected metres",
            stacklevel=2,
        )
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float64)
    safe = np.where(valid, sampled, 1.0).astype(np.float64)
    if fisheye is None:
        points = on_host(unproject, pixels, safe, viewmat, K)
    else:
        directions = rays(pixels, np.asarray(K), np.asarray(fisheye))
        valid &= np.isfinite(directions[..., 0])
        points = (directions * safe[..., None] - viewmat[:3, 3]) @ viewmat[:3, :3]
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
    """Unit quaternions wxyz that rotate the z axis onto `normals`; a zero normal gives the identity."""
    normals = np.asarray(normals, np.float64)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 0.0, 1.0])
    normals = np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), up)
    # Opposite normals give the same disc; the upper one avoids the half turn, whose axis is undefined.
    normals = np.where(normals[:, 2:] < 0, -normals, normals)
    half = np.column_stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(len(normals))])
    return half / np.linalg.norm(half, axis=1, keepdims=True)


def spacing_scales(
    points: Float[np.ndarray, "N 3"], *, clip_quantile: float = 0.95
) -> Float[np.ndarray, "N"]:
    """Neighbour spacing in metres, without outliers: capped at its `clip_quantile`, so that an isolated point
    does not become huge, and at least a thousandth of that, so that coinciding points keep some extent."""
    spacing = neighbor_spacing(np.asarray(points, np.float64))
    # "lower" takes a value that occurs: with few points, interpolation would let the outlier through.
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
    """A dense cloud of Gaussians, one per voxel, sized by the spacing of their neighbours.

    Args:
        points: metres; rows that are not finite are dropped.
        colors: RGB 0 to 1.
        voxel: edge of the voxels, each of which keeps one point, metres; 0 keeps all.
        opacity: opacity of all Gaussians, 0 to 1.
        scale_factor: standard deviation relative to the neighbour spacing.
        clip_quantile: spacings above this quantile are clipped to it.
        normals: None for spheres; "pca" for discs in the plane of their neighbours; or an array of normals.
        flatness: a disc's standard deviation along its normal relative to that in its plane.

    Raises:
        ValueError: no point is finite, or a shape or option is wrong.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected shape [M, 3], found {points.shape}")
    if colors.shape != points.shape:
        raise ValueError(f"colors: expected shape {points.shape} to match points, found {colors.shape}")
    if isinstance(normals, str) and normals != "pca":
        raise ValueError(
            f"normals: expected None, 'pca' or an array of shape {points.shape}, found {normals!r}"
        )
    if normals is not None and not isinstance(normals, str) and np.shape(normals) != points.shape:
        raise ValueError(f"normals: expected shape {points.shape} to match points, found {np.shape(normals)}")
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


def check_depth(depth: np.ndarray) -> None:
    """Check that `depth` is a depth image [H, W] of floats.

    Raises:
        ValueError: it has another shape, or holds integers, whose unit is unknown.
    """
    if depth.ndim != 2:
        raise ValueError(f"depth: expected shape [H, W], found {depth.shape}")
    if not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(
            f"depth: expected floats in metres (multiply by the file's unit), found dtype {depth.dtype}"
        )


def warn_of_hidden(points: Float[np.ndarray, "m 3"], frames: Sequence[Frame]) -> None:
    """Warns if most of what lies ahead of the cameras is nearer than their near plane, so never drawn.

    Args:
        points: points of the scene, in the unit of the poses.
        frames: frames of one camera each, on the host.
    """
    axes = np.stack([frame.cameras.viewmat[0][2] for frame in frames])
    some = points[:: 1 + len(points) // 1000]
    depths = some @ axes[:, :3].T + axes[:, 3]
    ahead, near = depths > 0, frames[0].cameras.near
    if ahead.any() and (depths < near)[ahead].mean() > _HIDDEN:
        warnings.warn(
            f"most of the scene is nearer to the cameras than their near plane, {near:g}, and is not drawn: "
            "is the unit of the poses far larger than the scene? Set near (--read.near) to less than "
            f"{np.median(depths[ahead]):.2g}",
            stacklevel=2,
        )


def on_host(function, *arrays):
    """Call a function of geometry.cameras with numpy arrays and return numpy arrays, in JAX's precision."""
    dtype = jnp.result_type(float)
    return jax.device_get(function(*jax.device_put([np.asarray(array, dtype) for array in arrays])))
