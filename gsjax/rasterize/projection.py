"""EWA projection of 3D Gaussians onto one image plane (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

The projected covariance is M M^T + eps2d I with M = J W R S (2x3). Its determinants are written as sums of
positive terms, |m1 x m2|^2 for M M^T (Cauchy-Binet), so needles and discs lose no digits to cancellation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import MIN_SQUARED_NORM
from gsjax.rasterize.plan import Plan

MIN_COMPENSATION = 0.005  # floor of the antialiasing factor


class Projected(NamedTuple):
    """What one camera sees of N Gaussians; rows that are not `visible` hold harmless numbers."""

    means2d: Float[Array, "n 2"]  # pixels
    conics: Float[Array, "n 3"]  # inverse covariance (A, B, C): A dx^2 + 2 B dx dy + C dy^2
    depths: Float[Array, "n"]  # z in the camera's frame, metres
    opacities: Float[Array, "n"]  # after antialiasing
    extents: Float[Array, "n 2"]  # half-widths of the box where alpha reaches alpha_min, pixels; else 0
    visible: Bool[Array, "n"]
    culled: Int[Array, ""]  # rows refused for their values: not finite, no rotation, no area


def _finite_rows(*arrays: Float[Array, "n ..."]) -> Bool[Array, "n"]:
    flags = [jnp.isfinite(a).all(axis=tuple(range(1, a.ndim))) for a in arrays]
    return jnp.stack(flags).all(axis=0)


def _stored(flags: Bool[Array, "n"]) -> Bool[Array, "n"]:
    """The same flags, stored: XLA:CPU would work them out again in each of the places where they are used.

    It does so with everything but what it deems expensive, such as a square root; barriers it drops.
    """
    return jnp.sqrt(flags.astype(jnp.float32)) > 0.5


def _columns(a: Float[Array, "n k"]) -> list[Float[Array, "n"]]:
    """Columns apart: arithmetic on whole columns is what a CPU vectorises."""
    return [a[:, i] for i in range(a.shape[1])]


def _rotate(matrix: Float[Array, "3 3"], vector: list) -> list:
    """By explicit products: a matmul may be less precise on accelerators."""
    return [sum(matrix[i, j] * vector[j] for j in range(3)) for i in range(3)]


def _to_camera(means, viewmat):
    return [c + viewmat[i, 3] for i, c in enumerate(_rotate(viewmat[:3, :3], means))]


def _rotation_columns(quats):
    """Columns of the rotation matrices of (not necessarily unit) quaternions."""
    w, x, y, z = quats
    unit = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * unit, x * unit, y * unit, z * unit
    return (
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    )


def _project_local(local, quats, scales, opacities, viewmat, K, plan: Plan):
    """Columns of (means2d, conics, opacities, variances, determinant), without a thought for bad values."""
    x, y, z = local
    fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
    # Far outside the image the linearisation J would explode: its x/z is held near the frame.
    margin_x, margin_y = 0.15 * plan.width / fx, 0.15 * plan.height / fy
    tx = jnp.clip(x / z, -cx / fx - margin_x, (plan.width - cx) / fx + margin_x)
    ty = jnp.clip(y / z, -cy / fy - margin_y, (plan.height - cy) / fy + margin_y)
    # Rows of M = J W R S, one entry for each of the Gaussian's axes. They divide last because XLA:CPU stores
    # a quotient, while products and sums it would work out again wherever they are used.
    row_u, row_v = [], []
    for axis, scale in zip(_rotation_columns(quats), scales, strict=True):
        in_x, in_y, in_z = _rotate(viewmat[:3, :3], axis)
        slope_y = in_y - ty * in_z
        row_u.append((fx * (in_x - tx * in_z) + skew * slope_y) * scale / z)
        row_v.append(fy * slope_y * scale / z)

    def dot(a, b):
        return sum(p * q for p, q in zip(a, b, strict=True))

    xx, xy, yy = dot(row_u, row_u), dot(row_u, row_v), dot(row_v, row_v)
    normal = [row_u[i] * row_v[j] - row_u[j] * row_v[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    det = dot(normal, normal)
    eps = plan.eps2d
    det_blurred = det + eps * (xx + yy) + eps * eps
    xx, yy = xx + eps, yy + eps
    conics = [yy / det_blurred, -xy / det_blurred, xx / det_blurred]
    if plan.rasterize_mode == "antialiased":
        opacities = opacities * jnp.sqrt(jnp.maximum(det / det_blurred, MIN_COMPENSATION**2))
    means2d = [(fx * x + skew * y) / z + cx, fy * y / z + cy]
    return means2d, conics, opacities, [xx, yy], det_blurred


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
    sound = _finite_rows(means, quats, scales, opacities) & usable & camera_finite
    if means2d_offset is not None:
        sound &= _finite_rows(means2d_offset)
    # Unlike jnp.clip this hands the whole gradient on at exactly 0 and 1.
    opacities = jnp.where(opacities < 0, 0.0, jnp.where(opacities > 1, 1.0, opacities))

    means, quats, scales = (_columns(a) for a in (means, quats, scales))

    # First on values alone: which rows can be drawn, and how far they reach.
    values = jax.lax.stop_gradient((means, quats, scales, opacities, viewmat, K, means2d_offset))
    local = _to_camera(values[0], values[4])
    means2d, conics, alphas, variances, det = _project_local(local, *values[1:6], plan)
    means2d = jnp.stack(means2d, axis=-1) + (0.0 if means2d_offset is None else values[6])
    squared = sum(c * c for c in values[1])
    sound &= (squared >= MIN_SQUARED_NORM) & jnp.isfinite(squared)
    # The gradient of 1 / det holds its square. A det of 0, infinity or NaN fails too.
    finite = [jnp.isfinite(c) for c in (*conics, *variances, det, 1 / (det * det))]
    has_area = jnp.isfinite(means2d).all(axis=1) & jnp.stack(finite).all(axis=0)
    z = local[2]
    in_range = (z > plan.near_plane) & (z < plan.far_plane)
    culled = jnp.sum(~sound | (in_range & ~has_area))

    # The box in which alpha = o exp(-q/2) reaches alpha_min, that is q <= 2 ln(o / alpha_min).
    reach = 2 * jnp.log(jnp.maximum(alphas / plan.alpha_min, 1e-30))
    half = jnp.sqrt(jnp.maximum(reach, 0.0)[:, None] * jnp.stack(variances, axis=-1))
    half = half * 1.0001 + 1e-3  # rounding must not shave a pixel off
    size = jnp.array([plan.width, plan.height], means2d.dtype)
    in_frame = ((means2d + half > 0) & (means2d - half < size)).all(axis=1)
    visible = sound & in_range & has_area & (reach > 0) & in_frame
    visible = _stored(visible)

    # Then in earnest, on inputs whose other rows are harmless: their gradients are zero, and never 0 * inf.
    def kept(columns, harmless):
        return [jnp.where(visible, c, h) for c, h in zip(columns, harmless, strict=True)]

    quats, scales = kept(quats, (1.0, 0.0, 0.0, 0.0)), kept(scales, (1.0, 1.0, 1.0))
    opacities = jnp.where(visible, opacities, 0.0)
    local = kept(_to_camera(kept(means, (0.0, 0.0, 0.0)), viewmat), (0.0, 0.0, 1.0))
    means2d, conics, opacities, _, _ = _project_local(local, quats, scales, opacities, viewmat, K, plan)
    means2d = jnp.stack(means2d, axis=-1)
    if means2d_offset is not None:
        means2d = means2d + jnp.where(visible[:, None], means2d_offset, 0.0)
    return Projected(
        means2d=means2d,
        conics=jnp.stack(conics, axis=-1),
        depths=local[2],
        opacities=opacities,
        extents=jnp.where(visible[:, None], half, 0.0),
        visible=visible,
        culled=culled.astype(jnp.int32),
    )
