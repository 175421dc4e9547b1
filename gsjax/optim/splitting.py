"""Adaptive density control (Kerbl et al. 2023, section 5.2): where the gradients of the projected means (the
"pull") are large, small Gaussians are cloned and large ones split; transparent and oversized ones are pruned.

Copies go to vacant slots, so shapes stay the same until the slots run out; then the host allocates more.
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
"""Factor by which the two halves of a split Gaussian are smaller."""
RESET_OPACITY = 0.01
"""Upper bound on opacities after a reset: Gaussians that are needed soon recover, the rest are pruned."""


class Pull(NamedTuple):
    """Accumulated gradients of the projected means.

    Attributes:
        total: sum over steps of the gradient norms, in units of half the image's width and height.
        seen: number of steps with a non-zero gradient.
    """

    total: Float[Array, "n"]
    seen: Float[Array, "n"]

    @property
    def mean(self) -> Float[Array, "n"]:
        """Mean gradient norm over the steps with a non-zero gradient."""
        return self.total / jnp.maximum(self.seen, 1.0)


def accumulate_pull() -> optax.GradientTransformation:
    """An optimizer for the zeros [1,n,2] that are added to the projected means: it leaves them unchanged and
    accumulates their gradients in a `Pull`. Gradients must be per half image, not per pixel."""

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


def strongly_pulled(gaussians: Gaussians, pull: Pull, threshold: float) -> Bool[Array, "n"]:
    """Which living Gaussians have a mean pull above the threshold."""
    return is_alive(gaussians) & (pull.mean > threshold)


def densify(
    gaussians: Gaussians,
    pull: Pull,
    key: PRNGKeyArray,
    slots: Int[Array, ""] | int,
    *,
    threshold: float,
    large: Float[Array, ""] | float,
    too_large: Float[Array, ""] | float,
) -> tuple[Gaussians, Bool[Array, "n"]]:
    """Clone, split and prune. If vacant slots are too few, the Gaussians with the strongest pull go first.

    Args:
        gaussians: Gaussians in all slots.
        pull: gradients accumulated since the last call.
        key: random key; the halves of a split Gaussian are sampled from it.
        slots: only the first `slots` slots may be filled.
        threshold: mean pull above which a Gaussian is cloned or split.
        large: a Gaussian is cloned if its largest scale is at most this, else split, metres.
        too_large: a Gaussian whose largest scale exceeds this is pruned, metres.

    Returns:
        The Gaussians, and which of them are new or were split: their optimizer state should be reset.
    """
    count = gaussians.num
    largest = gaussians.scales.max(-1)
    fits = is_alive(gaussians) & (largest <= too_large)
    candidate = strongly_pulled(gaussians, pull, threshold) & fits
    vacant = ~fits & (jnp.arange(count) < slots)
    # The k-th candidate, strongest pull first, takes the k-th vacant slot.
    parents = jnp.argsort(jnp.where(candidate, -pull.mean, jnp.inf))
    places = jnp.argsort(~vacant, stable=True)
    served = jnp.arange(count) < jnp.minimum(candidate.sum(), vacant.sum())
    source = jnp.arange(count).at[jnp.where(served, places, count)].set(parents, mode="drop")
    new = source != jnp.arange(count)
    copied_from = jnp.zeros(count, bool).at[jnp.where(served, parents, count)].set(True, mode="drop")
    halved = copied_from & (largest > large)

    pruned = eqx.tree_at(
        lambda g: g.logit_opacities, gaussians, jnp.where(fits, gaussians.logit_opacities, EMPTY_LOGIT)
    )
    copied = jax.tree.map(lambda leaf: leaf[source], pruned)
    split = halved[source]
    local = jax.random.normal(key, copied.means.shape, copied.means.dtype) * copied.scales
    shift = jnp.einsum("nij,nj->ni", quats_to_matrices(copied.quats), local)
    means = copied.means + jnp.where(split[:, None], shift, 0.0)
    log_scales = copied.log_scales - jnp.where(split, jnp.log(SHRINK), 0.0)[:, None]
    return eqx.tree_at(lambda g: (g.means, g.log_scales), copied, (means, log_scales)), new | split


def reset_opacities(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with opacities limited to `RESET_OPACITY`."""
    most = jnp.log(RESET_OPACITY) - jnp.log1p(-RESET_OPACITY)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, jnp.minimum(gaussians.logit_opacities, most))
