"""The map from the teacher's channels back to the field's, learned with the cycle loss (FD-3DGS, eq. 9;
`gsjax.losses.features.cycle_error`). The alternative is the pseudo-inverse, `jnp.linalg.pinv`.

With W fixed, as in the paper, and F = W F'_low, the second term of the loss is 0. What remains is linear L1
regression on the features that occur, so the learned map need not be an inverse elsewhere.
"""

from functools import partial

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from gsjax.losses.features import cycle_error

_RATE = 3e-3


@partial(jax.jit, static_argnames=("iterations", "batch"))
def learned_inverse(
    lift: Float[Array, "d channels"],
    features: Float[Array, "n channels"],
    key: Array,
    iterations: int = 500,
    batch: int = 2048,
) -> tuple[Float[Array, "channels d"], Float[Array, "iterations"]]:
    """An inverse of a fixed convolution, trained with Adam on the cycle loss; and the loss of each step.

    Args:
        lift: the convolution, W.
        features: features F'_low of pixels or Gaussians.
        key: one key, of shape [], for the initial values and the batches.
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
    return jnp.asarray(inverse), losses
