"""EWA projection of 3D Gaussians onto one image plane (Zwicker et al. 2001; Kerbl et al. 2023, eq. 5).

The projected covariance is M M^T + eps2d I with M = J W R S (2x3). Its determinants are written as sums of
positive terms, |m1 x m2|^2 for M M^T (Cauchy-Binet), so needles and discs lose no digits to cancellation.
J is the Jacobian of a lens (see `gsjax.rasterize.lenses`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.rotations import MIN_SQUARED_NORM
from gsjax.rasterize.lanes import columns_in_lanes, flat, in_lanes
from gsjax.rasterize.lenses import Linearised, fisheye, pinhole
from gsjax.rasterize.plan import Plan

MIN_COMPENSATION = 0.005  # floor of the antialiasing factor
OVERFLOW_MARGIN = 1e8  # factor by which drawn variances and determinants stay below the largest float


class Projected(NamedTuple):
    """What one camera sees of N Gaussians; rows that are not `visible` hold harmless numbers."""

    means2d: Float[Array, "n 2"]  # pixels
    conics: Float[Array, "n 3"]  # inverse covariance (A, B, C): A dx^2 + 2 B dx dy + C dy^2
    depths: Float[Array, "n"]  # z in the camera's frame, metres; of a fisheye the distance from it
    opacities: Float[Array, "n"]  # after antialiasing
    extents: Float[Array, "n 2"]  # half-widths of the box where alpha reaches alpha_min, pixels; else 0
    visible: Bool[Array, "n"]
    culled: Int[Array, ""]  # rows rejected for their values: not finite, no rotation, no area


def _all_finite(columns: list[Array]) -> Bool[Array, "rows lanes"]:
    return jnp.stack([jnp.isfinite(c) for c in columns]).all(axis=0)


def _materialised(flags: Bool[Array, "rows lanes"]) -> Bool[Array, "rows lanes"]:
    """The same flags, stored in memory: XLA:CPU would recompute them at each use.

    It recomputes everything except what it considers expensive, such as a square root, and drops barriers.
    """
    return jnp.sqrt(flags.astype(jnp.float32)) > 0.5


def _rotate(matrix: Float[Array, "3 3"], vector: list) -> list:
    """Rotate by explicit products: a matmul may be less precise on accelerators."""
    return [sum(matrix[i, j] * vector[j] for j in range(3)) for i in range(3)]


def _to_camera(means, viewmat):
    return [c + viewmat[i, 3] for i, c in enumerate(_rotate(viewmat[:3, :3], means))]


@jax.custom_jvp
def _quotient(a: Float[Array, "*n"], b: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """a / b with a derivative that does not square b: the determinant of a needle can be 1e26."""
    return a / b


@_quotient.defjvp
def _quotient_jvp(primals, tangents):
    (a, b), (da, db) = primals, tangents
    ratio = a / b
    return ratio, (da - ratio * db) / b


def _rotation_columns(quats):
    """Columns of the rotation matrices of (not necessarily unit) quaternions."""
    # First divide by a number near their length: the derivative of rsqrt contains its cube.
    largest = jax.lax.stop_gradient(jnp.stack([jnp.abs(c) for c in quats]).max(axis=0))
    w, x, y, z = (c / largest for c in quats)
    unit = jax.lax.rsqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * unit, x * unit, y * unit, z * unit
    return (
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    )


def _project_local(at: Linearised, quats, scales, opacities, viewmat, K, plan: Plan):
    """Columns of (means2d, conics, opacities, variances, determinant), without checks for bad values."""
    fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
    # Rows of M = J W R S, one entry for each of the Gaussian's axes. They divide last because XLA:CPU stores
    # quotients, while it would recompute products and sums wherever they are used.
    row_u, row_v = [], []
    for axis, scale in zip(_rotation_columns(quats), scales, strict=True):
        slope_x, slope_y = at.slopes(_rotate(viewmat[:3, :3], axis))
        row_u.append(_quotient((fx * slope_x + skew * slope_y) * scale, at.depth))
        row_v.append(_quotient(fy * slope_y * scale, at.depth))

    def dot(a, b):
        return sum(p * q for p, q in zip(a, b, strict=True))

    xx, xy, yy = dot(row_u, row_u), dot(row_u, row_v), dot(row_v, row_v)
    normal = [row_u[i] * row_v[j] - row_u[j] * row_v[i] for i, j in ((1, 2), (2, 0), (0, 1))]
    det = dot(normal, normal)
    eps = plan.eps2d
    det_blurred = det + eps * (xx + yy) + eps * eps
    xx, yy = xx + eps, yy + eps
    conics = [_quotient(c, det_blurred) for c in (yy, -xy, xx)]
    if plan.rasterize_mode == "antialiased":
        opacities = opacities * jnp.sqrt(jnp.maximum(_quotient(det, det_blurred), MIN_COMPENSATION**2))
    means2d = [_quotient(fx * at.x + skew * at.y, at.depth) + cx, _quotient(fy * at.y, at.depth) + cy]
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
    coeffs: Float[Array, "4"] | None = None,
) -> Projected:
    """Project N Gaussians into one camera.

    A row that is not finite, has |q|^2 < 1e-12, no area on the image or depth outside (near, far), or does
    not reach into the frame, is not visible and has gradients of exactly zero: visibility is determined
    first, from values alone; then the same arithmetic runs on inputs in which such rows are replaced.

    Args:
        means, quats, scales, opacities: the Gaussians, as for `gsjax.rasterization`.
        usable: rows whose colours can be drawn.
        viewmat, K: the camera: world to camera, and intrinsics in pixels.
        plan: image size and options.
        means2d_offset: added to the projected means, pixels.
        coeffs: k1 to k4 of a fisheye; None for a pinhole.
    """
    n = means.shape[0]
    # The gradients of the bounds of x/z contain 1 / focal^2. A focal length of 0 fails too.
    slopes = jnp.stack([c / (f * f) for f in (K[0, 0], K[1, 1]) for c in (1.0, K[0, 2], K[1, 2])])
    camera_finite = jnp.isfinite(viewmat).all() & jnp.isfinite(K).all() & jnp.isfinite(slopes).all()
    if coeffs is not None:
        camera_finite &= jnp.isfinite(coeffs).all()
        coeffs = jnp.where(camera_finite, coeffs, 0.0)
    viewmat = jnp.where(camera_finite, viewmat, jnp.eye(4, dtype=viewmat.dtype))
    K = jnp.where(camera_finite, K, jnp.eye(3, dtype=K.dtype))

    def linearised(local, K, coeffs):
        return pinhole(local, K, plan) if coeffs is None else fisheye(local, coeffs)

    mean, quat, scale = (columns_in_lanes(a) for a in (means, quats, scales))  # lists of columns
    opacities, usable = in_lanes(opacities), in_lanes(usable)
    offset = [] if means2d_offset is None else columns_in_lanes(means2d_offset)
    sound = _all_finite([*mean, *quat, *scale, opacities, *offset]) & usable & camera_finite
    # Unlike jnp.clip this passes the whole gradient at exactly 0 and 1.
    opacities = jnp.where(opacities < 0, 0.0, jnp.where(opacities > 1, 1.0, opacities))

    # First on values alone: which rows can be drawn, and how far they reach.
    values = jax.lax.stop_gradient((mean, quat, scale, opacities, viewmat, K))
    local = _to_camera(values[0], values[4])
    at = linearised(local, values[5], coeffs if coeffs is None else jax.lax.stop_gradient(coeffs))
    (u, v), conics, alphas, variances, det = _project_local(at, *values[1:], plan)
    if offset:
        du, dv = jax.lax.stop_gradient(offset)
        u, v = u + du, v + dv
    squared = sum(c * c for c in values[1])
    sound &= (squared >= MIN_SQUARED_NORM) & jnp.isfinite(squared)
    # The gradient of 1 / det contains its square. A det of 0, infinity or NaN fails too.
    large = [OVERFLOW_MARGIN * c for c in (*variances, det)]  # allows for factors in the gradients
    has_area = _all_finite([u, v, *conics, *large, 1 / (det * det)])
    in_range = (at.depth > plan.near_plane) & (at.depth < plan.far_plane)
    if at.seen is not None:
        in_range &= at.seen
    culled = flat(~sound | (in_range & ~has_area), n).sum(dtype=jnp.int32)

    # The box in which alpha = o exp(-q/2) reaches alpha_min, that is q <= 2 ln(o / alpha_min).
    reach = 2 * jnp.log(jnp.maximum(alphas / plan.alpha_min, 1e-30))
    # Rounding must not cut off a pixel.
    half_x, half_y = (jnp.sqrt(jnp.maximum(reach, 0.0) * c) * 1.0001 + 1e-3 for c in variances)
    in_frame = (u + half_x > 0) & (u - half_x < plan.width) & (v + half_y > 0) & (v - half_y < plan.height)
    visible = _materialised(sound & in_range & has_area & (reach > 0) & in_frame)

    # Then again, on inputs whose invisible rows are harmless: their gradients are zero, and never 0 * inf.
    # What is harmless depends on the camera: its first visible row is. A camera without any is replaced.
    sees = visible.any()
    viewmat = jnp.where(sees, viewmat, jnp.eye(4, dtype=viewmat.dtype))
    K = jnp.where(sees, K, jnp.eye(3, dtype=K.dtype))
    coeffs = coeffs if coeffs is None else jnp.where(sees, coeffs, 0.0)

    def kept(columns, harmless, seen=None):
        if seen is not None and visible.size:
            first = jnp.argmax(visible)
            harmless = [jnp.where(sees, c.ravel()[first], h) for c, h in zip(seen, harmless, strict=True)]
        return [jnp.where(visible, c, h) for c, h in zip(columns, harmless, strict=True)]

    quat = kept(quat, (1.0, 0.0, 0.0, 0.0), values[1])
    scale = kept(scale, (1.0, 1.0, 1.0), values[2])
    opacities = jnp.where(visible, opacities, 0.0)
    mean = kept(mean, (0.0, 0.0, 0.0), values[0])
    local = kept(_to_camera(mean, viewmat), (0.0, 0.0, 1.0), local)
    at = linearised(local, K, coeffs)
    means2d, conics, opacities, _, _ = _project_local(at, quat, scale, opacities, viewmat, K, plan)
    if offset:
        means2d = [c + d for c, d in zip(means2d, kept(offset, (0.0, 0.0)), strict=True)]

    # Without the barrier XLA:GPU would recompute the whole projection for every column that is stacked.
    columns = (means2d, conics, at.depth, opacities, kept((half_x, half_y), (0.0, 0.0)))
    means2d, conics, depths, opacities, extents = jax.lax.optimization_barrier(columns)

    def stacked(columns):
        return jnp.stack([flat(c, n) for c in columns], axis=-1)

    return Projected(
        means2d=stacked(means2d),
        conics=stacked(conics),
        depths=flat(depths, n),
        opacities=flat(opacities, n),
        extents=stacked(extents),
        visible=flat(visible, n),
        culled=culled,
    )
