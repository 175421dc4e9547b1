"""Image differences as residuals for `gsjax.optim.least_squares`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from gsjax.optim.least_squares import huber


def block_residual(
    difference: Float[Array, "c height width d"],
    weights: Float[Array, "c height width #d"],
    limit: float,
    block: int,
    softness: float,
) -> Float[Array, "c rows columns d"]:
    """Residuals whose half squares sum to the weighted sum of min(|difference|, limit), for blocks of one
    pixel and differences above `softness` times the limit. Smaller differences are smoothed (Huber), because
    an absolute value has no curvature that Gauss-Newton could use.

    Args:
        difference: rendered minus observed.
        weights: weights of the differences.
        limit: larger differences are truncated: they belong to a different object.
        block: width in pixels of the blocks over which differences are averaged. How a single rendered pixel
            changes depends on the Gaussian whose edge it lies on; this is unrelated to the motion, but counts
            in J^T J like image gradients, which makes steps short. Pixels outside full blocks are left out.
        softness: fraction of the limit below which differences are smoothed.
    """
    total = _summed(weights, block)
    mean = _summed(difference * weights, block) / jnp.maximum(total, 1e-6)
    rounded = softness * limit
    return huber(jnp.clip(mean, -limit, limit), rounded) * jnp.sqrt(total / rounded)


def _summed(values: Float[Array, "c height width d"], block: int) -> Float[Array, "c rows columns d"]:
    """Sums over blocks of `block` by `block` pixels."""
    cameras, height, width, channels = values.shape
    values = values[:, : height // block * block, : width // block * block]
    values = values.reshape(cameras, height // block, block, width // block, block, channels)
    return values.sum((2, 4))
