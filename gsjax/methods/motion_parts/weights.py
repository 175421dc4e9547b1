"""Skinning weights from a feature grid over the scene, warmed up on what was lifted (papers/001, 3.3)."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from gsjax.scene.feature_grid import FeatureGrid, FeatureGridConfig, Located, init_feature_grid

_RATE = 1e-2
_MARGIN = 0.05  # of the box, beyond the outermost Gaussians, in its own size


def new_grid(
    key: PRNGKeyArray, config: FeatureGridConfig, means: Float[Array, "M 3"], parts: int
) -> FeatureGrid:
    """A grid over the box of the movable Gaussians, with an output for each part."""
    low, high = means.min(0), means.max(0)
    room = _MARGIN * jnp.maximum((high - low).max(), 1e-3)
    return init_feature_grid(key, config, parts, jnp.stack([low - room, high + room]))


@partial(jax.jit, static_argnames="iterations")
def warmed_up(
    grid: FeatureGrid,
    located: Located,
    weights: Float[Array, "M P"],
    alive: Bool[Array, "P"],
    iterations: int = 100,
) -> tuple[FeatureGrid, Float[Array, "iterations"]]:
    """The grid that says these weights, as far as it can, by cross-entropy; and the loss over the iterations.

    Args:
        grid: to begin with.
        located: where the Gaussians lie in it.
        weights: to learn.
        alive: which slots hold a handle; the others get no weight.
        iterations: steps of Adam.
    """
    optimizer = optax.adam(_RATE, eps=1e-12)

    def loss(grid):
        logits = jnp.where(alive, grid.at(located), -1e9)
        return -jnp.mean(jnp.sum(weights * jax.nn.log_softmax(logits), axis=-1))

    def step(carry, _):
        grid, state = carry
        value, slope = jax.value_and_grad(loss)(grid)
        updates, state = optimizer.update(slope, state)
        return (eqx.apply_updates(grid, updates), state), value

    (grid, _), losses = jax.lax.scan(step, (grid, optimizer.init(grid)), length=iterations)
    return grid, losses
