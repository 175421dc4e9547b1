"""EWA projection of 3D Gaussians onto one image plane (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

The projected covariance is M M^T + eps2d I with M = J W R S (2x3). Its determinants are written as sums of
positive terms, |m1 x m2|^2 for M M^T (Cauchy-Binet), so needles and discs lose no digits to cancellation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import MIN_SQUARED_NORM, quats_to_matrices
from gsjax.rasterize.plan import Plan

ALPHA_MIN = 1 / 255  # a fainter contribution is skipped
MAX_SIGMA = 3.33  # no Gaussian reaches further, in standard deviations
MIN_COMPENSATION = 0.005  # floor of the antialiasing factor


class Projected(NamedTuple):
    """What one camera sees of N Gaussians; rows that are not `visible` hold harmless numbers."""

    means2d: Float[Array, "n 2"]  # pixels
    conics: Float[Array, "n 3"]  # inverse covariance (A, B, C): A dx^2 + 2 B dx dy + C dy^2
    depths: Float[Array, "n"]  # z in the camera's frame, metres
    opacities: Float[Array, "n"]  # after antialiasing
    extents: Float[Array, "n 2"]  # half-widths of the box where alpha can be 1/255, pixels; else 0
    visible: Bool[Array, "n"]
    culled: Int[Array, ""]  # rows refused for their values: not finite, no rotation, no area


def _finite_rows(*arrays: Float[Array, "n ..."]) -> Bool[Array, "n"]:
    flags = [jnp.isfinite(a).all(axis=tuple(range(1, a.ndim))) for a in arrays]
    return jnp.stack(flags).all(axis=0)


def _image_covariance(local, quats, scales, viewmat, K, width, height):
    """Rows of M = J W R S, and the focal-plane position of each mean."""
    x, y, z = local[:, 0], local[:, 1], local[:, 2]
    fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
    # Far outside the image the linearisation J would explode: its x/z is held near the frame.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = jnp.clip(x / z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = jnp.clip(y / z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    rotations = quats_to_matrices(quats)
    axes = jnp.einsum("ij,njk->nik", viewmat[:3, :3], rotations, precision="highest") * scales[:, None, :]
    axes = axes / z[:, None, None]
    slope_x, slope_y = axes[:, 0] - tx[:, None] * axes[:, 2], axes[:, 1] - ty[:, None] * axes[:, 2]
    row_u, row_v = fx * slope_x + skew * slope_y, fy * slope_y
    means2d = jnp.stack([(fx * x + skew * y) / z + cx, fy * y / z + cy], axis=-1)
    return row_u, row_v, means2d


def _to_camera(means, viewmat):
    """Means in the camera's frame, by explicit products: a matmul may be less precise on accelerators."""
    return sum(means[:, i : i + 1] * viewmat[:3, i] for i in range(3)) + viewmat[:3, 3]


def _project_local(local, quats, scales, opacities, viewmat, K, offset, plan: Plan):
    """(means2d, conics, opacities, variances (xx, yy), determinant), without a thought for bad values."""
    row_u, row_v, means2d = _image_covariance(local, quats, scales, viewmat, K, plan.width, plan.height)
    xx, xy, yy = (row_u * row_u).sum(1), (row_u * row_v).sum(1), (row_v * row_v).sum(1)
    normal = _cross(row_u, row_v)
    det = (normal * normal).sum(1)
    eps = plan.eps2d
    det_blurred = det + eps * (xx + yy) + eps * eps
    xx, yy = xx + eps, yy + eps
    conics = jnp.stack([yy, -xy, xx], axis=-1) / det_blurred[:, None]
    if plan.rasterize_mode == "antialiased":
        ratio = jnp.maximum(det / det_blurred, MIN_COMPENSATION**2)
        opacities = opacities * jnp.sqrt(ratio)
    return means2d + offset, conics, opacities, jnp.stack([xx, yy], axis=-1), det_blurred


def _cross(a, b):
    ax, ay, az = a[:, 0], a[:, 1], a[:, 2]
    bx, by, bz = b[:, 0], b[:, 1], b[:, 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def project_gaussians(
    means: Float[Array, "n 3"],
    quats: Float[Array, "n 4"],
    scales: Float[Array, "n 3"],
    opacities: Float[Array, "n"],
    usable: Bool[Array, "n"],
    viewmat: Float[Array, "4 4"],
    K: Float[Array, "3 3"],
    plan: Plan,
    means2d_offset: Float[Array, "n 2"] | None = None,
) -> Projected:
    """Project N Gaussians into one camera.

    A row that is not finite, has |q|^2 < 1e-12, no area on the image or z outside (near, far), or does not
    reach into the frame, is not visible and its gradients are exactly zero: visibility is found first, on
    values alone; then the same arithmetic runs on inputs in which such rows were replaced. `usable` marks
    rows whose colours can be drawn.
    """
    camera_finite = jnp.isfinite(viewmat).all() & jnp.isfinite(K).all() & (K[0, 0] * K[1, 1] != 0)
    viewmat = jnp.where(camera_finite, viewmat, jnp.eye(4, dtype=viewmat.dtype))
    K = jnp.where(camera_finite, K, jnp.eye(3, dtype=K.dtype))
    offset = jnp.zeros_like(means[:, :2]) if means2d_offset is None else means2d_offset
    sound = _finite_rows(means, quats, scales, opacities, offset) & usable & camera_finite
    # Unlike jnp.clip this hands the whole gradient on at exactly 0 and 1.
    opacities = jnp.where(opacities < 0, 0.0, jnp.where(opacities > 1, 1.0, opacities))

    # First on values alone: which rows can be drawn, and how far they reach.
    values = jax.lax.stop_gradient((means, quats, scales, opacities, viewmat, K, offset))
    local = _to_camera(values[0], values[4])
    means2d, conics, alphas, variances, det = _project_local(local, *values[1:], plan)
    squared = (values[1] * values[1]).sum(1)
    sound &= (squared >= MIN_SQUARED_NORM) & jnp.isfinite(squared)
    # The gradient of 1 / det holds its square. A det of 0, infinity or NaN fails too.
    has_area = _finite_rows(means2d, conics, variances) & jnp.isfinite(det) & jnp.isfinite(1 / (det * det))
    z = local[:, 2]
    in_range = (z > plan.near_plane) & (z < plan.far_plane)
    culled = jnp.sum(~sound | (in_range & ~has_area))

    # The box in which alpha = o exp(-q/2) >= 1/255, that is q <= 2 ln(255 o).
    reach = jnp.minimum(MAX_SIGMA**2, 2 * jnp.log(jnp.maximum(alphas / ALPHA_MIN, 1e-30)))
    half = jnp.sqrt(jnp.maximum(reach, 0.0)[:, None] * variances)
    half = half * 1.0001 + 1e-3  # rounding must not shave a pixel off
    size = jnp.array([plan.width, plan.height], means2d.dtype)
    in_frame = ((means2d + half > 0) & (means2d - half < size)).all(axis=1)
    visible = sound & in_range & has_area & (reach > 0) & in_frame

    # Then in earnest, on inputs whose other rows are harmless: their gradients are zero, and never 0 * inf.
    keep = visible[:, None]
    means = jnp.where(keep, means, 0.0)
    quats = jnp.where(keep, quats, jnp.array([1.0, 0.0, 0.0, 0.0], quats.dtype))
    scales = jnp.where(keep, scales, 1.0)
    opacities = jnp.where(visible, opacities, 0.0)
    offset = jnp.where(keep, offset, 0.0)
    local = jnp.where(keep, _to_camera(means, viewmat), jnp.array([0.0, 0.0, 1.0], means.dtype))
    inputs = (quats, scales, opacities, viewmat, K, offset)
    means2d, conics, opacities, _, _ = _project_local(local, *inputs, plan)
    return Projected(
        means2d=means2d,
        conics=conics,
        depths=local[:, 2],
        opacities=opacities,
        extents=jnp.where(keep, half, 0.0),
        visible=visible,
        culled=culled.astype(jnp.int32),
    )
