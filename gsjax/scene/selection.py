"""Operations on selected Gaussians of a scene: extract, remove, hide, tint, shift."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gsjax.geometry.spherical_harmonics import SH_C0, rgb_to_sh0
from gsjax.scene.gaussians import Gaussians

_LUMA = (0.2126, 0.7152, 0.0722)  # for linear RGB (ITU-R BT.709), here applied to the colours as they are
_DARK = 0.02  # mean luma below which shades are noise
_INVISIBLE = -40.0  # an opacity logit


def only(gaussians: Gaussians, selected: Bool[Array | np.ndarray, "n"]) -> Gaussians:
    """The selected Gaussians, in their order. On the host, where a new number of rows compiles nothing."""
    rows = np.flatnonzero(selected)
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), gaussians)


def without(gaussians: Gaussians, selected: Bool[Array | np.ndarray, "n"]) -> Gaussians:
    """All Gaussians except the selected ones, in their order. On the host, as `only`."""
    return only(gaussians, ~np.asarray(selected))


def hidden(gaussians: Gaussians, selected: Bool[Array, "n"]) -> Gaussians:
    """The same number of Gaussians with the selected ones made invisible; it renders like `without`."""
    logits = jnp.where(selected, _INVISIBLE, gaussians.logit_opacities)
    return eqx.tree_at(lambda g: g.logit_opacities, gaussians, logits)


def tinted(gaussians: Gaussians, selected: Bool[Array, "n"], color: Float[Array, "3"]) -> Gaussians:
    """The selected Gaussians in another, view-independent colour; their relative brightness is kept.

    Args:
        gaussians: the scene.
        selected: the Gaussians whose colour changes.
        color: RGB, 0 to 1: the average colour of the selected Gaussians, before clipping to 1. Black objects
            get it uniformly, because their shades are noise.
    """
    luma = jnp.clip(0.5 + SH_C0 * gaussians.sh0[:, 0], 0, 1) @ jnp.asarray(_LUMA, gaussians.sh0.dtype)
    mean = jnp.sum(jnp.where(selected, luma, 0)) / jnp.maximum(jnp.sum(selected), 1)
    shades = jnp.where(mean < _DARK, 1.0, luma / jnp.maximum(mean, _DARK))
    rgb = jnp.clip(jnp.asarray(color) * shades[:, None], 0, 1)
    sh0 = jnp.where(selected[:, None, None], rgb_to_sh0(rgb)[:, None], gaussians.sh0)
    found = eqx.tree_at(lambda g: g.sh0, gaussians, sh0)
    if gaussians.shN is None:
        return found
    return eqx.tree_at(lambda g: g.shN, found, jnp.where(selected[:, None, None], 0, gaussians.shN))


def shifted(gaussians: Gaussians, selected: Bool[Array, "n"], by: Float[Array, "3"]) -> Gaussians:
    """The selected Gaussians translated by `by`, in metres."""
    means = gaussians.means + jnp.where(selected[:, None], jnp.asarray(by, gaussians.means.dtype), 0)
    return eqx.tree_at(lambda g: g.means, gaussians, means)
