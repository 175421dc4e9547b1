"""What skinning weights are made of: a feature grid over the scene, fitted at first to what was lifted
(MotionSplicer, section 3.3), or a table."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from gsjax.methods.parts.config import PartsConfig
from gsjax.scene.feature_grid import FeatureGrid, Located, init_feature_grid, locate

_RATE = 1e-2
_MARGIN = 0.05  # of the box, beyond the outermost Gaussians, in its own size
_LEAST = 1e-4  # weight; smaller ones count as this large where they become logits


class SimplexTable(eqx.Module):
    """Weights themselves, a row for each Gaussian; the optimizer keeps them on the simplex."""

    weights: Float[Array, "M P"]


Field = FeatureGrid | SimplexTable | Float[Array, "M P"]
"""What weights are made of: a grid over the canonical scene, a table of them, or one of their logits."""


def new_field(
    key: PRNGKeyArray, config: PartsConfig, means: Float[Array, "M 3"], parts: int
) -> tuple[Field, Located | None]:
    """The field that `config.weights` names, and where the Gaussians lie in it; a grid is over their box.

    Args:
        key: random key of a grid's first values.
        config: with the kind of weights.
        means: of the movable Gaussians, metres.
        parts: how many columns weights have.
    """
    if config.weights != "grid":
        empty = jnp.zeros((len(means), parts))
        return (SimplexTable(empty) if config.weights == "simplex" else empty), None
    low, high = means.min(0), means.max(0)
    room = _MARGIN * jnp.maximum((high - low).max(), 1e-3)
    grid = init_feature_grid(key, config.grid, parts, jnp.stack([low - room, high + room]))
    return grid, locate(grid, means)


def weights_of(field: Field, located: Located | None, alive: Bool[Array, "P"]) -> Float[Array, "M P"]:
    """Weights that sum to 1, and 0 for slots that are not alive."""
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
    """The field that has these weights, and the losses of its fit: a table has them at once, a grid as far as
    it comes in the given number of steps.

    Args:
        field: of the kind that is wanted; a grid begins with its values.
        located: where Gaussians lie in a grid.
        weights: targets; rows sum to 1.
        alive: parts that there are.
        iterations: steps of a grid.
    """
    if isinstance(field, SimplexTable):
        return SimplexTable(weights), np.zeros(0)
    if not isinstance(field, FeatureGrid):
        return jnp.log(jnp.maximum(weights, _LEAST)), np.zeros(0)
    assert located is not None
    grid, losses = warmed_up(field, located, weights, alive, iterations)
    return grid, np.asarray(losses)


@partial(jax.jit, static_argnames="iterations")
def warmed_up(
    grid: FeatureGrid,
    located: Located,
    weights: Float[Array, "M P"],
    alive: Bool[Array, "P"],
    iterations: int = 100,
) -> tuple[FeatureGrid, Float[Array, "iterations"]]:
    """The grid fitted to these weights by cross-entropy, and the loss over the iterations.

    Args:
        grid: to begin with.
        located: where the Gaussians lie in it.
        weights: targets.
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
