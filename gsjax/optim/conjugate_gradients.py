"""Preconditioned conjugate gradients for many right-hand sides with one matrix, one iteration at a time
(Hestenes and Stiefel 1952). The caller computes the products A d: renderings and their transposes, which
dominate the cost.

    state = turned(Conjugate(zeros, zeros, zeros), b - A x, scale)
    x, state = advanced(x, state, A @ state.direction, scale)
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Conjugate(NamedTuple):
    """The state between iterations; zeros before the first.

    Attributes:
        residual: b - A x.
        direction: the next direction d.
        energy: of each column, the squared preconditioned residual.
    """

    residual: Float[Array, "n c"]
    direction: Float[Array, "n c"]
    energy: Float[Array, "c"]


def advanced(
    x: Float[Array, "n c"], state: Conjugate, product: Float[Array, "n c"], scale: Float[Array, "n"]
) -> tuple[Float[Array, "n c"], Conjugate]:
    """The solution and the state after an iteration. Each column has its own step length.

    Args:
        x: the solution before.
        state: the state before.
        product: A d.
        scale: the preconditioner, a diagonal near that of A.
    """
    length = _ratio(state.energy, jnp.sum(state.direction * product, axis=0))
    return x + length * state.direction, turned(state, state.residual - length * product, scale)


def turned(state: Conjugate, residual: Float[Array, "n c"], scale: Float[Array, "n"]) -> Conjugate:
    """The state for a new residual, with a direction that is conjugate to the previous one.

    Args:
        state: the state before.
        residual: the new residual.
        scale: the preconditioner.
    """
    scaled = residual / scale[:, None]
    energy = jnp.sum(residual * scaled, axis=0)
    return Conjugate(residual, scaled + _ratio(energy, state.energy) * state.direction, energy)


def _ratio(above: Float[Array, "c"], below: Float[Array, "c"]) -> Float[Array, "c"]:
    """The quotient; 0 where there is nothing to divide by."""
    return jnp.where(below > 0, above / jnp.where(below > 0, below, 1.0), 0.0)
