"""Weights whose rows stay on the probability simplex: no entry below 0, and a sum of 1.

The projection is jaxopt's, which is no longer developed: only this module imports it, and optax has an
equivalent should it disappear. jaxopt's `ProjectedGradient` is not used: its line search evaluates one loss
repeatedly, while ours sees a different view in each step. `simplex_descent` is an optimizer like optax's:

    gradient_step(loss, simplex_descent(0.01))                                                weights alone
    gradient_step(loss, per_field_adam(rates, others={"weights": simplex_descent(0.01)}))     and other fields
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

_DECAY, _SQUARE_DECAY, _EPS = 0.9, 0.999, 1e-15  # as for Adam elsewhere


@partial(jax.jit, inline=True)
def project_simplex(values: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
    """The nearest point on the simplex for each row: max(v - tau, 0), with tau such that it sums to 1.

    The derivative passes the tangents of the entries above 0, less their mean, and 0 for the others, also at
    kinks. An entry of -inf becomes 0; a row with a NaN or +inf becomes NaN and affects no other row.
    """
    from jaxopt.projection import projection_simplex  # imported late, as it warns and few need it

    # A constant added to a row changes nothing; without the largest entry, sums of large values stay exact.
    offsets = jax.lax.stop_gradient(values.max(axis=-1, keepdims=True))
    rows = (values - offsets).reshape(-1, values.shape[-1])
    return jax.vmap(projection_simplex)(rows).reshape(values.shape)


class _Moments(NamedTuple):
    count: Int[Array, ""]
    mean: PyTree
    square: PyTree


def simplex_descent(rate: optax.ScalarOrSchedule) -> optax.GradientTransformationExtraArgs:
    """Projected gradient descent with Adam's moments, for arrays [..., P] whose rows lie on the simplex.

    For each row w with gradient g, centred to mean 0 because the projection ignores the mean:

        m <- 0.9 m + 0.1 g,    v <- 0.999 v + 0.001 mean(g^2),    w <- project_simplex(w - rate m / sqrt(v))

    with m and v bias-corrected as in Adam. Adam itself, with one v per entry, converges to wrong points: if
    all gradients of a row have the same sign, however unequal, it moves all entries alike, and the projection
    undoes that. With one v per row, it stops where plain projected descent does.

    Its `update` also accepts `allowed` [P]: where it is False, entries are 0 and stay 0.

    Args:
        rate: learning rate, roughly the change of an entry per step; or a schedule of it.
    """
    scale = optax.scale_by_learning_rate(rate)

    def init(weights):
        square = jax.tree.map(lambda w: jnp.zeros_like(w[..., :1]), weights)
        moments = _Moments(jnp.zeros((), jnp.int32), jax.tree.map(jnp.zeros_like, weights), square)
        return moments, scale.init(weights)

    def update(gradients, state, weights, *, allowed=True, **_):
        (state, scaling) = state
        centered = jax.tree.map(lambda g: _centered(g, allowed), gradients)
        squares = jax.tree.map(lambda g: jnp.mean(g**2, axis=-1, keepdims=True, where=allowed), centered)
        mean = optax.tree_utils.tree_update_moment(centered, state.mean, _DECAY, order=1)
        square = optax.tree_utils.tree_update_moment(squares, state.square, _SQUARE_DECAY, order=1)
        count = state.count + 1
        m = optax.tree_utils.tree_bias_correction(mean, _DECAY, count)
        v = optax.tree_utils.tree_bias_correction(square, _SQUARE_DECAY, count)
        moves = jax.tree.map(lambda m, v: m / (jnp.sqrt(v) + _EPS), m, v)
        moves, scaling = scale.update(moves, scaling)
        moved = jax.tree.map(lambda u, w: jnp.where(allowed, w + u, -jnp.inf), moves, weights)
        updates = jax.tree.map(lambda m, w: project_simplex(m) - w, moved, weights)
        return updates, (_Moments(count, mean, square), scaling)

    return optax.GradientTransformationExtraArgs(init, update)


def _centered(
    gradient: Float[Array, "*batch P"], allowed: Bool[Array, "P"] | bool
) -> Float[Array, "*batch P"]:
    mean = gradient.mean(axis=-1, keepdims=True, where=allowed)
    return jnp.where(allowed, gradient - mean, 0.0)
