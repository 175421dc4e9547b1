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
    extents: Float[Array, "n 2"]  # half-widths in pixels of the box outside which alpha < 1/255; 0 if not visible
    visible: Bool[Array, "n"]
    culled: Int[Array, ""]  # rows refused for their values: not finite, no rotation, no area


def _finite_rows(*arrays: Float[Array, "n ..."]) -> Bool[Array, "n"]:
    flags = [jnp.isfinite(a).reshape(a.shape[0], -1).all(axis=1) for a in arrays]
    return jnp.stack(flags).all(axis=0)


def _image_covariance(local, quats, scales, viewmat, K, width, height):
    """Rows of M = J W R S, and the focal-plane position of each mean."""
    x, y, z = local[:, 0], local[:, 1], local[:, 2]
    fx, skew, cx, fy, cy = K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2]
    # Far outside the image the linearisation J would explode: its x/z is held near the frame.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = jnp.clip(x / z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = jnp.clip(y / z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    axes = jnp.einsum("ij,njk->nik", viewmat[:3, :3], quats_to_matrices(quats)) * scales[:, None, :]
    axes = axes / z[:, None, None]
    row_v = fy * (axes[:, 1] - ty[:, None] * axes[:, 2])
    row_u = fx * (axes[:, 0] - tx[:, None] * axes[:, 2]) + skew * (axes[:, 1] - ty[:, None] * axes[:, 2])
    means2d = jnp.stack([(fx * x + skew * y) / z + cx, fy * y / z + cy], axis=-1)
    return row_u, row_v, means2d


def _project(means, quats, scales, opacities, viewmat, K, plan: Plan):
    """Projection without a thought for bad values; also the determinant, for the caller to judge."""
    # Three explicit products: a matmul may run in lower precision on accelerators.
    local = sum(means[:, i : i + 1] * viewmat[:3, i] for i in range(3)) + viewmat[:3, 3]
    return local, *_project_local(local, quats, scales, opacities, viewmat, K, plan)


def _project_local(local, quats, scales, opacities, viewmat, K, plan: Plan):
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
    return means2d, conics, opacities, xx, yy, det_blurred


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

    A row that is not finite, has |q|^2 < 1e-12, no area on the image or z outside (near, far) is not visible
    and its gradients are exactly zero: validity is found first, on values alone; then the same arithmetic
    runs on inputs in which such rows were replaced. `usable` marks rows whose colours can be drawn.
    """
    camera_finite = jnp.isfinite(viewmat).all() & jnp.isfinite(K).all() & (K[0, 0] * K[1, 1] != 0)
    viewmat = jnp.where(camera_finite, viewmat, jnp.eye(4, dtype=viewmat.dtype))
    K = jnp.where(camera_finite, K, jnp.eye(3, dtype=K.dtype))
    opacities = jnp.clip(opacities, 0.0, 1.0)

    inputs = (means, quats, scales, opacities)
    sound = _finite_rows(*inputs) & usable & ((quats * quats).sum(1) >= MIN_SQUARED_NORM) & camera_finite
    if means2d_offset is not None:
        sound &= _finite_rows(means2d_offset)
    local, means2d, conics, _, xx, yy, det = _project(*jax.lax.stop_gradient((*inputs, viewmat, K)), plan)
    z = local[:, 2]
    in_range = (z > plan.near_plane) & (z < plan.far_plane)
    has_area = _finite_rows(means2d, conics, xx, yy) & jnp.isfinite(det) & (det > 0)
    drawable = sound & in_range & has_area
    culled = jnp.sum(~sound | (in_range & ~has_area))

    keep = drawable[:, None]
    means = jnp.where(keep, means, 0.0)
    quats = jnp.where(keep, quats, jnp.array([1.0, 0.0, 0.0, 0.0], quats.dtype))
    scales = jnp.where(keep, scales, 1.0)
    opacities = jnp.where(drawable, opacities, 0.0)
    local = sum(means[:, i : i + 1] * viewmat[:3, i] for i in range(3)) + viewmat[:3, 3]
    local = jnp.where(keep, local, jnp.array([0.0, 0.0, 1.0], local.dtype))
    means2d, conics, opacities, xx, yy, _ = _project_local(local, quats, scales, opacities, viewmat, K, plan)
    if means2d_offset is not None:
        means2d = means2d + jnp.where(keep, means2d_offset, 0.0)

    # The box in which alpha = o exp(-q/2) >= 1/255, that is q <= 2 ln(255 o).
    reach = jnp.minimum(MAX_SIGMA**2, 2 * jnp.log(jnp.maximum(opacities / ALPHA_MIN, 1e-30)))
    half = jnp.sqrt(jnp.maximum(reach, 0.0)[:, None] * jnp.stack([xx, yy], axis=-1))
    half = jax.lax.stop_gradient(half) * 1.0001 + 1e-3  # rounding must not shave a pixel off
    size = jnp.array([plan.width, plan.height], means2d.dtype)
    position = jax.lax.stop_gradient(means2d)
    in_frame = ((position + half > 0) & (position - half < size)).all(axis=1)
    visible = drawable & (reach > 0) & in_frame
    return Projected(
        means2d=means2d,
        conics=conics,
        depths=local[:, 2],
        opacities=opacities,
        extents=jnp.where(visible[:, None], half, 0.0),
        visible=visible,
        culled=culled.astype(jnp.int32),
    )
