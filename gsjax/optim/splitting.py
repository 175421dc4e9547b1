"""Adaptive density control (Kerbl et al. 2023, section 5.2): where the projected means are pulled hard, small
Gaussians are cloned and large ones split; what is transparent or too large is pruned.

Copies go to slots that hold none, so shapes stay until the slots run out: then the host takes more.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.optim.densification import EMPTY_LOGIT, is_alive
from gsjax.scene.gaussians import Gaussians

SHRINK = 1.6
"""How many times smaller the two halves of a split Gaussian are."""
RESET_OPACITY = 0.01
"""Opacity above which a reset leaves none: what is needed soon comes back, the rest is pruned."""


class Pull(NamedTuple):
    """How hard the projected means were pulled, as far as it is known.

    Attributes:
        total: sum over steps of the norms of their gradients, by half the picture's width and height.
        seen: in how many steps there was one.
    """

    total: Float[Array, "n"]
    seen: Float[Array, "n"]

    @property
    def mean(self) -> Float[Array, "n"]:
        """Of the steps that pulled."""
        return self.total / jnp.maximum(self.seen, 1.0)


def watch_pull() -> optax.GradientTransformation:
    """What the optimizer does with zeros [1,n,2] that were added to the projected means: it leaves them, and
    keeps a `Pull` of their gradients, which must be by half a picture and not by pixels."""

    def init(params) -> Pull:
        zeros = jnp.zeros((2, _only(params).shape[1]), _only(params).dtype)
        return Pull(zeros[0], zeros[1])

    def update(updates, state: Pull, params=None):
        norms = jnp.linalg.norm(_only(updates)[0], axis=-1)
        known = Pull(state.total + norms, state.seen + (norms > 0))
        return jax.tree.map(jnp.zeros_like, updates), known

    return optax.GradientTransformation(init, update)


def _only(tree) -> Array:
    (leaf,) = jax.tree.leaves(tree)
    return leaf


def wanted(gaussians: Gaussians, pull: Pull, threshold: float) -> Bool[Array, "n"]:
    """Which Gaussians are pulled harder than the threshold."""
    return is_alive(gaussians) & (pull.mean > threshold)


def divide(
    gaussians: Gaussians,
    pull: Pull,
    key: PRNGKeyArray,
    slots: Int[Array, ""] | int,
    *,
    threshold: float,
    large: float,
    too_large: Float[Array, ""] | float,
) -> tuple[Gaussians, Bool[Array, "n"]]:
    """Clone, split and prune. Where vacant slots are too few, those that are pulled hardest come first.

    Args:
        gaussians: of all slots.
        pull: since the last time.
        key: says where the halves of a split Gaussian go: drawn from itself.
        slots: only the first so many may be filled.
        threshold: of the mean pull.
        large: largest scale up to which one is cloned, and above which it is split, metres.
        too_large: largest scale above which one is pruned, metres.

    Returns:
        The Gaussians, and which of them are new or were split: their optimizer should forget what it knew.
    """
    count = gaussians.num
    largest = gaussians.scales.max(-1)
    fits = is_alive(gaussians) & (largest <= too_large)
    asks = wanted(gaussians, pull, threshold) & fits
    vacant = ~fits & (jnp.arange(count) < slots)
    # The k-th that asks, hardest pulled first, takes the k-th vacant slot.
    askers = jnp.argsort(jnp.where(asks, -pull.mean, jnp.inf))
    places = jnp.argsort(~vacant, stable=True)
    served = jnp.arange(count) < jnp.minimum(asks.sum(), vacant.sum())
    source = jnp.arange(count).at[jnp.where(served, places, count)].set(askers, mode="drop")
    new = source != jnp.arange(count)
    got = jnp.zeros(count, bool).at[jnp.where(served, askers, count)].set(True, mode="drop")
    halved = got & (largest > large)

    pruned = eqx.tree_at(
        lambda g: g.logit_opacities, gaussians, jnp.where(fits, gaussians.logit_opacities, EMPTY_LOGIT)
    )
    copied = jax.tree.map(lambda leaf: leaf[source], pruned)
    split = halved[source]
    local = jax.random.normal(key, copied.means.shape, copied.means.dtype) * copied.scales
    away = jnp.einsum("nij,nj->ni", quats_to_matrices(copied.quats), local)
    means = copied.means + jnp.where(split[:, None], away, 0.0)
    log_scales = copied.log_scales - jnp.where(split, jnp.log(SHRINK), 0.0)[:, None]
    return eqx.tree_at(lambda g: (g.means, g.log_scales), copied, (means, log_scales)), new | split


def with_low_opacities(gaussians: Gaussians) -> Gaussians:
    """None more opaque than `RESET_OPACITY`."""
    most = jnp.log(RESET_OPACITY) - jnp.log1p(-RESET_OPACITY)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, jnp.minimum(gaussians.logit_opacities, most))
