"""Densification by relocation with a fixed number of slots (3DGS-MCMC, Kheradmand et al. 2024).

All slots exist from the start, so shapes never change and nothing recompiles. A slot whose opacity is at most
`DEAD` holds no Gaussian: it is not drawn, and other Gaussians can be copied to it.
"""

from functools import cache
from math import comb
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.gaussians import Gaussians

DEAD = 0.005
"""Opacity up to which a Gaussian counts as dead (3DGS-MCMC; 3DGS prunes below it)."""

EMPTY_LOGIT = -20.0
"""Opacity logit of a slot that has never held a Gaussian: the opacity is below 1/255, so it is not drawn."""

_FAINTEST_COPY = 1.001 * DEAD  # still above DEAD when it has been stored as a logit
_MOST_COPIES = 51  # most copies of one Gaussian at once, as in the reference implementation
_SHARPNESS, _FAINT = 100.0, 0.005  # of the sigmoid that exempts opaque Gaussians from the noise


def is_alive(gaussians: Gaussians) -> Bool[Array, "n"]:
    """Which slots hold a Gaussian."""
    return gaussians.opacities > DEAD


def relocate(
    gaussians: Gaussians, key: PRNGKeyArray, slots: Int[Array, ""]
) -> tuple[Gaussians, Bool[Array, "n"]]:
    """Turn dead slots into copies of living Gaussians, sampled in proportion to opacity, such that the image
    does not change.

    Each of n copies in one place has the opacity o' = 1 - (1 - o)^(1/n) and the covariance (eq. 9)

        S' = o^2 ( sum_{i=1..n} sum_{k=0..i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1) )^-2 S

    Args:
        gaussians: Gaussians in all slots.
        key: random key that selects the Gaussians to copy.
        slots: only the first `slots` slots may be filled.

    Returns:
        The Gaussians, and which of them are new or were copied: their optimizer state should be reset.
    """
    alive = is_alive(gaussians)
    count = gaussians.num
    vacant = ~alive & (jnp.arange(count) < slots) & alive.any()
    share = jnp.cumsum(jnp.where(alive, gaussians.opacities, 0.0))
    drawn = jax.random.uniform(key, (count,), share.dtype) * share[-1]
    source = jnp.clip(jnp.searchsorted(share, drawn, side="right"), 0, count - 1)
    source = jnp.where(alive[source], source, jnp.argmax(alive))  # rounding may select a dead one
    source = jnp.where(vacant, source, jnp.arange(count))
    copies = jnp.zeros(count, jnp.int32).at[source].add(vacant.astype(jnp.int32))
    copied = copies > 0
    opacities, shrink = split_into_copies(gaussians.opacities, jnp.clip(copies + 1, 1, _MOST_COPIES))
    logits = jnp.where(copied, jnp.log(opacities) - jnp.log1p(-opacities), gaussians.logit_opacities)
    log_scales = gaussians.log_scales + jnp.where(copied, jnp.log(shrink), 0.0)[:, None]
    shared = eqx.tree_at(lambda g: (g.logit_opacities, g.log_scales), gaussians, (logits, log_scales))
    return jax.tree.map(lambda leaf: leaf[source], shared), vacant | copied


def split_into_copies(
    opacities: Float[Array, "n"], copies: Int[Array, "n"]
) -> tuple[Float[Array, "n"], Float[Array, "n"]]:
    """The opacity of each of `copies` Gaussians that together look like one, and the factor on its scales.

    Opacities are clipped to between slightly more than DEAD and 1 - 1e-6, so that no copy starts dead and
    logits are finite.
    """
    opaque = jnp.clip(opacities, DEAD, 1 - 1e-6)
    each = -jnp.expm1(jnp.log1p(-opaque) / copies)
    table = jnp.asarray(_signed_sums(), opacities.dtype)  # [copies, k]
    powers = jnp.cumprod(jnp.broadcast_to(each[:, None], (len(each), _MOST_COPIES)), axis=1)
    total = (table[copies - 1] * powers).sum(-1)
    return jnp.clip(each, _FAINTEST_COPY, 1 - 1e-6), opaque / jnp.maximum(total, 1e-12)


@cache
def _signed_sums() -> Float[np.ndarray, "copies copies"]:
    """The factor of o'^(k+1) for each number of copies: (-1)^k / sqrt(k+1) sum_{i=1..n} C(i-1, k)."""
    table = np.zeros((_MOST_COPIES, _MOST_COPIES))
    for n in range(1, _MOST_COPIES + 1):
        for k in range(n):
            table[n - 1, k] = (-1) ** k / np.sqrt(k + 1) * comb(n, k + 1)  # the sum over i, in closed form
    return table


def exploration(
    gaussians: Gaussians, key: PRNGKeyArray, amount: Float[Array, ""] | float
) -> Float[Array, "n 3"]:
    """Noise for the means (eq. 7): S eta times `amount` for almost transparent Gaussians, which thereby find
    places where they are needed; opaque ones stay in place.

    Args:
        gaussians: Gaussians in all slots.
        key: random key for eta.
        amount: learning rate of the means times the strength of the noise. The noise is the product of it
            and a square of sizes; divide it by the square of the scene's radius for all to be in radii.
    """
    spread = jax.random.normal(key, gaussians.means.shape, gaussians.means.dtype)
    rotations = quats_to_matrices(gaussians.quats)
    local = jnp.einsum("nji,nj->ni", rotations, spread) * gaussians.scales**2
    faint = jax.nn.sigmoid(_SHARPNESS * (1 - gaussians.opacities - (1 - _FAINT)))
    return amount * faint[:, None] * jnp.einsum("nij,nj->ni", rotations, local)


State = TypeVar("State")


def reset_rows(state: State, rows: Bool[Array, "n"]) -> State:
    """An optimizer state with these rows set to zero in every array that has one row per Gaussian.

    Args:
        state: the optimizer state.
        rows: the rows to reset.
    """

    def reset(leaf):
        if not hasattr(leaf, "shape") or leaf.ndim == 0 or leaf.shape[0] != len(rows):
            return leaf
        return jnp.where(rows.reshape(-1, *[1] * (leaf.ndim - 1)), 0, leaf)

    return jax.tree.map(reset, state)
