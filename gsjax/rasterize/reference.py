"""A reference rasterizer, as plain and as slow as possible: every Gaussian at every pixel, in float64.

Apart from spherical harmonics it shares no code with the fast path, and its gradients are plain autodiff. It
also marks the pixels whose value depends on a comparison that rounding could reverse (the thresholds of
alpha, the early stop, the order of nearly equal depths); there, two correct renderings may differ by up to
1/255.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.spherical_harmonics import evaluate_sh

_DOUBT = 1e-5  # relative distance to a threshold within which float32 may decide otherwise
_TIE = 5e-7  # the same for two depths: a few units in the last place of float32
_BLOCK = 256  # pixels at once; affects only speed and memory
_VISIBLE = 1e-3  # below this transmittance a flip changes a pixel by less than 4e-6


class Reference(NamedTuple):
    """The images of one camera, and which of their pixels are uncertain.

    Attributes:
        colors: channels selected by `render_mode`; depth comes last.
        alphas: 0 to 1.
        features: None if none were given.
        doubtful: pixels that depend on a comparison that rounding could reverse.
    """

    colors: Float[Array, "height width d"]
    alphas: Float[Array, "height width 1"]
    features: Float[Array, "height width f"] | None
    doubtful: Bool[Array, "height width"]


def _rotation(q):
    w, x, y, z = q / jnp.linalg.norm(q)
    return jnp.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _through_fisheye(point, K, fisheye):
    """Pixel position of a point in the camera's frame (Kannala and Brandt 2006)."""
    x, y, z = point
    radius = jnp.sqrt(x * x + y * y)
    theta = jnp.arctan2(radius, z)
    bent = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(fisheye))
    u, v = bent / radius * point[:2]
    return jnp.array([K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2]])


def _splat(mean, quat, scale, opacity, viewmat, K, width, height, eps2d, antialiased, fisheye):
    """Image mean, conic, depth and opacity of one Gaussian, by the textbook formulas."""
    rotation = _rotation(quat)
    covariance = rotation @ jnp.diag(scale**2) @ rotation.T
    x, y, z = viewmat[:3, :3] @ mean + viewmat[:3, 3]
    fx, fy, cx, cy, skew = K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1]
    tan_x, tan_y = width / (2 * fx), height / (2 * fy)
    tx = z * jnp.clip(x / z, -(cx / fx + 0.3 * tan_x), (width - cx) / fx + 0.3 * tan_x)
    ty = z * jnp.clip(y / z, -(cy / fy + 0.3 * tan_y), (height - cy) / fy + 0.3 * tan_y)
    jacobian = jnp.array([[fx / z, skew / z, -(fx * tx + skew * ty) / z**2], [0.0, fy / z, -fy * ty / z**2]])
    mean2d, depth = jnp.array([(fx * x + skew * y) / z + cx, fy * y / z + cy]), z
    if fisheye is not None:
        local = jnp.array([x, y, z])
        jacobian = jax.jacfwd(_through_fisheye)(local, K, fisheye)
        mean2d, depth = _through_fisheye(local, K, fisheye), jnp.linalg.norm(local)
    to_image = jacobian @ viewmat[:3, :3]
    exact = to_image @ covariance @ to_image.T
    blurred = exact + eps2d * jnp.eye(2)
    det, det_blurred = jnp.linalg.det(exact), jnp.linalg.det(blurred)
    if antialiased:
        opacity = opacity * jnp.sqrt(jnp.maximum(det / det_blurred, 0.005**2))
    return mean2d, jnp.linalg.inv(blurred), depth, opacity


def rasterization_reference(
    means: Float[Array, "n 3"],
    quats: Float[Array, "n 4"],
    scales: Float[Array, "n 3"],
    opacities: Float[Array, "n"],
    colors: Float[Array, "n *sh d"],
    viewmat: Float[Array, "4 4"],
    K: Float[Array, "3 3"],
    width: int,
    height: int,
    *,
    fisheye: Float[Array, "4"] | None = None,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    background: Float[Array, "d"] | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    features: Float[Array, "n f"] | None = None,
    alpha_min: float = 1 / 255,
    alpha_max: float = 0.99,
    min_transmittance: float = 1e-4,
) -> Reference:
    """Render one scene in one camera, exactly; arguments as for `gsjax.rasterization`. All Gaussians must be
    drawable, and none may lie exactly on the axis of a fisheye."""
    antialiased = rasterize_mode == "antialiased"
    means2d, conics, depths, opacities = jax.vmap(
        lambda *g: _splat(*g, viewmat, K, width, height, eps2d, antialiased, fisheye)
    )(means, quats, scales, opacities)
    if sh_degree is not None:
        center = -viewmat[:3, :3].T @ viewmat[:3, 3]
        colors = jnp.maximum(evaluate_sh(sh_degree, colors, means - center), 0.0)
    order = jnp.argsort(depths, stable=True)
    unsorted = (means2d, conics, depths, opacities, colors)
    means2d, conics, depths, opacities, colors = (a[order] for a in unsorted)
    in_range = (depths > near_plane) & (depths < far_plane)
    painted = [colors, depths[:, None]] + ([] if features is None else [features[order]])
    painted = jnp.where(in_range[:, None], jnp.concatenate(painted, axis=-1), 0.0)
    gaps = jnp.abs(jnp.diff(depths)) <= _TIE * jnp.abs(depths[1:])

    def some_pixels(pixels):
        dx, dy = (pixels[:, None, :] - means2d).transpose(2, 1, 0)  # [N, pixels]
        a, b, c, d = (conics[:, i, j, None] for i in range(2) for j in range(2))
        raw = opacities[:, None] * jnp.exp(-0.5 * (a * dx * dx + (b + c) * dx * dy + d * dy * dy))
        alpha = jnp.minimum(raw, alpha_max)
        drawn = in_range[:, None] & (alpha >= alpha_min)
        alpha = jnp.where(drawn, alpha, 0.0)
        # A product from front to back, one Gaussian after the other.
        _, before = jax.lax.scan(lambda t, a: (t * (1 - a), t), jnp.ones(len(pixels)), alpha)
        after = before * (1 - alpha)
        weights = jnp.where(after > min_transmittance, alpha * before, 0.0)

        def near(value, threshold, where):
            return jnp.any(where & (jnp.abs(value / threshold - 1) < _DOUBT), axis=0)

        seen = in_range[:, None] & (before > _VISIBLE)
        doubtful = near(raw, alpha_min, seen) | near(raw, alpha_max, seen)
        doubtful |= near(after, min_transmittance, drawn)
        doubtful |= jnp.any(gaps[:, None] & drawn[1:] & drawn[:-1] & seen[:-1], axis=0)
        return weights.T @ painted, weights.sum(axis=0), doubtful

    x, y = jnp.meshgrid(jnp.arange(width) + 0.5, jnp.arange(height) + 0.5)
    pixels = jnp.stack([x, y], axis=-1).reshape(-1, 2)
    # A few hundred pixels at a time, whose intermediate values are recomputed for the gradient.
    pixels = jnp.pad(pixels, ((0, -len(pixels) % _BLOCK), (0, 0))).reshape(-1, _BLOCK, 2)
    blocks = jax.lax.map(jax.checkpoint(some_pixels), pixels)
    values, alphas, doubtful = (
        a.reshape(-1, *a.shape[2:])[: width * height].reshape(height, width, *a.shape[2:]) for a in blocks
    )
    num_colors = colors.shape[-1]
    image, depth = values[..., :num_colors], values[..., num_colors : num_colors + 1]
    if background is not None:
        image = image + (1 - alphas)[..., None] * background
    if "ED" in render_mode:
        depth = depth / jnp.maximum(alphas, 1e-10)[..., None]
    parts = ([image] if "RGB" in render_mode else []) + ([depth] if "D" in render_mode else [])
    return Reference(
        colors=jnp.concatenate(parts, axis=-1),
        alphas=alphas[..., None],
        features=None if features is None else values[..., num_colors + 1 :],
        doubtful=doubtful,
    )
