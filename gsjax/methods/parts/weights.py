"""Fields of skinning weights: a feature grid over the scene, initially fitted to the lifted weights
(MotionSplicer, section 3.3), or a table."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from gsjax.methods.parts.config import PartsConfig
from gsjax.optim.step import steady_adam
from gsjax.scene.feature_grid import FeatureGrid, Located, init_feature_grid, locate

_RATE = 1e-2
_MARGIN = 0.05  # of the grid's box around the outermost Gaussians, relative to its size
_LEAST = 1e-4  # smallest weight when weights are converted to logits


class SimplexTable(eqx.Module):
    """The weights of each Gaussian; the optimizer keeps them on the simplex."""

    weights: Float[Array, "M P"]


Field = FeatureGrid | SimplexTable | Float[Array, "M P"]
"""A grid over the canonical scene, a table of weights, or a table of their logits."""


def new_field(
    key: PRNGKeyArray, config: PartsConfig, means: Float[Array, "M 3"], parts: int
) -> tuple[Field, Located | None]:
    """A new field of the kind that `config.weights` names, and the Gaussians' locations in it. A grid spans
    their bounding box.

    Args:
        key: random key for the initial values of a grid.
        config: selects the kind of field.
        means: means of the movable Gaussians, metres.
        parts: number of weights per Gaussian.
    """
    if config.weights != "grid":
        empty = jnp.zeros((len(means), parts))
        return (SimplexTable(empty) if config.weights == "simplex" else empty), None
    on_host = np.asarray(means)
    low, high = on_host.min(0), on_host.max(0)
    room = _MARGIN * max((high - low).max(), 1e-3)
    grid = init_feature_grid(key, config.grid, parts, np.stack([low - room, high + room]))
    return grid, locate(grid, means)


@partial(jax.jit, inline=True)
def weights_of(field: Field, located: Located | None, alive: Bool[Array, "P"]) -> Float[Array, "M P"]:
    """The weights of a field, which sum to 1 and are 0 for slots that are not alive."""
    if isinstance(field, SimplexTable):
        return field.weights
    logits = field.at(located) if isinstance(field, FeatureGrid) else field
    return jax.nn.softmax(jnp.where(alive, logits, -jnp.inf))


def fit_field_to_weights(
    field: Field,
    located: Located | None,
    weights: Float[Array, "M P"],
    alive: Bool[Array, "P"],
    iterations: int = 100,
) -> tuple[Field, Float[np.ndarray, "iterations"]]:
    """A field with the given weights, and the losses of its fit. A table takes the weights exactly; a grid is
    fitted to them by cross-entropy.

    Args:
        field: a field of the desired kind; the fit of a grid starts from it.
        located: the Gaussians' locations in a grid.
        weights: target weights; rows sum to 1.
        alive: the slots that hold a part.
        iterations: steps of Adam for a grid.
    """
    if isinstance(field, SimplexTable):
        return SimplexTable(weights), np.zeros(0)
    if not isinstance(field, FeatureGrid):
        return jnp.log(jnp.maximum(weights, _LEAST)), np.zeros(0)
    assert located is not None
    grid, losses = _fitted_grid(field, located, weights, alive, iterations)
    return grid, np.asarray(losses)


@partial(jax.jit, static_argnames="iterations")
def _fitted_grid(grid: FeatureGrid, located: Located, weights, alive, iterations: int):
    optimizer = steady_adam(_RATE, eps=1e-12)

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
