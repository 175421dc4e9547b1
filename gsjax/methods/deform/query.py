"""Gaussians of a deforming scene that match a prompt (SurstSplat, section 2.4; GaussianClin, section 3.4)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.methods.query import directions

_LEAST_ALPHA = 0.5  # mean alpha below which a region shows nothing of the scene


def prompt_probabilities(
    features: Float[Array, "*n c"], prompts: Float[Array, "k c"], temperature: float = 0.1
) -> Float[Array, "*n k"]:
    """P(prompt | Gaussian or pixel): the softmax over prompts of cosines (SurstSplat, eqs. 16 and 17).

    The papers have no temperature: with cosines of 1 and 0, their probability is at most 0.73. All prompts
    are equally likely for a feature of length 0.

    Args:
        features: features of Gaussians, or rendered ones.
        prompts: the candidates, in the channels of the features.
        temperature: temperature of the softmax.
    """
    return jax.nn.softmax(directions(features) @ directions(prompts).T / temperature, axis=-1)


def most_likely(probabilities: Float[Array, "*n k"]) -> Int[Array, "*n"]:
    """The index of the most likely prompt; -1 where several are all equally likely."""
    apart = probabilities.max(axis=-1) > probabilities.min(axis=-1)
    return jnp.where(apart | (probabilities.shape[-1] == 1), probabilities.argmax(axis=-1), -1)


def region_feature(
    drawn: Float[np.ndarray, "height width c"],
    alphas: Float[np.ndarray, "height width"],
    box: tuple[float, float, float, float],
) -> Float[np.ndarray, "c"]:
    """The mean of the features rendered in a box; the feature of a single pixel if both corners lie in it.

    Args:
        drawn: features, composited like colours.
        alphas: rendered alphas.
        box: x0, y0, x1, y1 in pixels; every pixel that it touches counts.

    Raises:
        ValueError: the box does not lie in the image, or shows nothing of the scene.
    """
    height, width = alphas.shape
    x0, y0, x1, y1 = box
    if not (0 <= x0 <= x1 < width and 0 <= y0 <= y1 < height):
        found, corners = f"{x0:g},{y0:g}", ""
        if (x0, y0) != (x1, y1):
            found += f" to {x1:g},{y1:g}"
            corners = ", the first corner left of and above the second"
        raise ValueError(
            f"expected 0 <= X < {width} and 0 <= Y < {height}, pixels of the training images{corners}, "
            f"found {found}"
        )
    region = np.s_[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1]
    if alphas[region].mean() < _LEAST_ALPHA:
        raise ValueError("expected pixels that show the scene, found empty ones; choose others")
    return drawn[region].mean(axis=(0, 1))
