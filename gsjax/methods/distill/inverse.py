"""The way back from the teacher's channels to the field's (FD-3DGS, eq. 9): the pseudo-inverse, or one
learned with the cycle loss (`gsjax.losses.features.cycle_error`).

With W fixed, as in the paper, and F = W F'_low, the second term of the loss is 0. What remains is linear
regression in L1 on the features that occur, so the learned inverse need not be an inverse elsewhere.
"""

from functools import partial

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from gsjax.losses.features import cycle_error

_RATE = 3e-3


def pseudo_inverse(lift: Float[Array, "d channels"]) -> Float[Array, "channels d"]:
    """The Moore-Penrose inverse, by singular values."""
    return jnp.linalg.pinv(lift)


@partial(jax.jit, static_argnames=("iterations", "batch"))
def learned_inverse(
    lift: Float[Array, "d channels"],
    features: Float[Array, "n channels"],
    key: Array,
    iterations: int = 500,
    batch: int = 2048,
) -> tuple[Float[Array, "channels d"], Float[Array, "iterations"]]:
    """An inverse of a fixed convolution, by Adam on the cycle loss; and the loss over the iterations.

    Args:
        lift: the convolution, W.
        features: features F'_low of pixels or of Gaussians.
        key: one key, of shape [], for the first values and the batches.
        iterations: number of steps.
        batch: number of features in a step.
    """
    optimizer = optax.adam(optax.exponential_decay(_RATE, iterations, 0.03))

    def loss(inverse, some):
        return cycle_error(some, jnp.matmul(some, lift.T, precision="highest"), lift, inverse).mean()

    def step(carry, key):
        inverse, state = carry
        some = features[jax.random.randint(key, (batch,), 0, len(features))]
        value, slope = jax.value_and_grad(loss)(inverse, some)
        updates, state = optimizer.update(slope, state)
        return (optax.apply_updates(inverse, updates), state), value

    first, keys = jax.random.split(key)
    start = jax.random.normal(first, lift.T.shape, lift.dtype) / jnp.sqrt(lift.shape[0])
    (inverse, _), losses = jax.lax.scan(
        step, (start, optimizer.init(start)), jax.random.split(keys, iterations)
    )
    return inverse, losses
