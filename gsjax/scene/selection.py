"""What is done with some of a scene's Gaussians: taken out, tinted, put elsewhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.geometry.spherical_harmonics import SH_C0, rgb_to_sh0
from gsjax.scene.gaussians import Gaussians, take

_LUMA = (0.2126, 0.7152, 0.0722)  # of linear RGB (ITU-R BT.709), here of colours as they are


def without(gaussians: Gaussians, selected: Bool[Array, "n"]) -> Gaussians:
    """All others. Outside of a trace."""
    return take(gaussians, ~jnp.asarray(selected))


def tinted(gaussians: Gaussians, selected: Bool[Array, "n"], color: Float[Array, "3"]) -> Gaussians:
    """Selected ones in another colour, the same from all sides; what was bright stays brighter than what was
    dark.

    Args:
        gaussians: the scene.
        selected: whose colour changes.
        color: RGB, 0 to 1: what the selected ones are on average.
    """
    luma = jnp.clip(0.5 + SH_C0 * gaussians.sh0[:, 0], 0, 1) @ jnp.asarray(_LUMA, gaussians.sh0.dtype)
    mean = jnp.sum(jnp.where(selected, luma, 0)) / jnp.maximum(jnp.sum(selected), 1)
    rgb = jnp.clip(jnp.asarray(color) * (luma / jnp.maximum(mean, 1e-3))[:, None], 0, 1)
    sh0 = jnp.where(selected[:, None, None], rgb_to_sh0(rgb)[:, None], gaussians.sh0)
    found = eqx.tree_at(lambda g: g.sh0, gaussians, sh0)
    if gaussians.shN is None:
        return found
    return eqx.tree_at(lambda g: g.shN, found, jnp.where(selected[:, None, None], 0, gaussians.shN))


def shifted(gaussians: Gaussians, selected: Bool[Array, "n"], by: Float[Array, "3"]) -> Gaussians:
    """Selected ones elsewhere, by so many metres along each axis."""
    means = gaussians.means + jnp.where(selected[:, None], jnp.asarray(by, gaussians.means.dtype), 0)
    return eqx.tree_at(lambda g: g.means, gaussians, means)
