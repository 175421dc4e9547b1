"""Differences of pictures as residuals for `gsjax.optim.least_squares`."""

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
    """Residuals whose half squares sum up to the weighted sum of min(|difference|, limit), over blocks of
    one pixel and above `softness` times the limit; what is below is rounded off (Huber), for an absolute
    value has no curvature that Gauss-Newton could use.

    Args:
        difference: rendered minus observed.
        weights: what each counts.
        limit: a difference beyond it is that of another thing.
        block: differences are means over blocks so many pixels wide. How one rendered pixel changes depends
            on the Gaussian whose edge it lies at; that is no part of a motion, and in J^T J it counts like
            gradients of the picture, which makes steps short. Pixels that fill no block are left out.
        softness: share of the limit.
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
