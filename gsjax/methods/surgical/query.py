"""Which Gaussians of a deforming scene a prompt means (papers/003, section 2.4; papers/004, section 3.4)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_LEAST_NORM = 1e-6


def prompt_probabilities(
    features: Float[Array, "*n c"], prompts: Float[Array, "k c"], temperature: float = 0.1
) -> Float[Array, "*n k"]:
    """P(prompt | Gaussian), or of a pixel: a softmax over prompts of cosines (eqs. 16 and 17).

    The papers have no temperature, and so for cosines of 1 and 0 a probability of 0.73 at most. What has no
    length is as likely each of them.

    Args:
        features: of Gaussians, or rendered.
        prompts: what is asked and what it is told apart from, in the features' channels; a point's or a box's
            is the mean of the features rendered there.
        temperature: of the softmax.
    """
    return jax.nn.softmax(_directions(features) @ _directions(prompts).T / temperature, axis=-1)


def _directions(features: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    squared = jnp.sum(features**2, axis=-1, keepdims=True)
    there = squared > _LEAST_NORM**2
    return jnp.where(there, features / jnp.sqrt(jnp.where(there, squared, 1.0)), 0.0)
