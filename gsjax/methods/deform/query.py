"""Gaussians of a deforming scene that a prompt means (SurstSplat, section 2.4; GaussianClin, section 3.4)."""

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.methods.query import directions

_LITTLE = 0.5  # of a pixel's light that the scene must send, on average


def prompt_probabilities(
    features: Float[Array, "*n c"], prompts: Float[Array, "k c"], temperature: float = 0.1
) -> Float[Array, "*n k"]:
    """P(prompt | Gaussian), or of a pixel: a softmax over prompts of cosines (SurstSplat, eqs. 16 and 17).

    The papers have no temperature, and so for cosines of 1 and 0 a probability of 0.73 at most. What has no
    length is as likely each of them.

    Args:
        features: of Gaussians, or rendered.
        prompts: the candidates, in the features' channels; a point's or a box's
            is the mean of the features rendered there.
        temperature: of the softmax.
    """
    return jax.nn.softmax(directions(features) @ directions(prompts).T / temperature, axis=-1)


def most_likely(probabilities: Float[np.ndarray, "*n k"]) -> Int[np.ndarray, "*n"]:
    """The most likely row; -1 where all are as likely."""
    if probabilities.shape[-1] == 1:
        return np.zeros(probabilities.shape[:-1], int)
    apart = probabilities.max(axis=-1) > probabilities.min(axis=-1)
    return np.where(apart, probabilities.argmax(axis=-1), -1)


def region_feature(
    drawn: Float[np.ndarray, "height width c"],
    alphas: Float[np.ndarray, "height width"],
    box: tuple[float, float, float, float],
) -> Float[np.ndarray, "c"]:
    """The mean of the features rendered in a box; of the pixel, where both of its corners lie in one.

    Args:
        drawn: features, composited as colours are.
        alphas: of the picture.
        box: x0, y0, x1, y1 in pixels; those that it touches count.

    Raises:
        ValueError: it does not lie in the picture, or there is nothing of the scene in it.
    """
    height, width = alphas.shape
    x0, y0, x1, y1 = box
    if not (0 <= x0 <= x1 < width and 0 <= y0 <= y1 < height):
        found, corners = f"{x0:g},{y0:g}", ""
        if (x0, y0) != (x1, y1):
            found += f" to {x1:g},{y1:g}"
            corners = ", the first corner left of and above the second"
        raise ValueError(
            f"expected 0 <= X < {width} and 0 <= Y < {height}, pixels as they were learned{corners}, "
            f"found {found}"
        )
    region = np.s_[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1]
    if alphas[region].mean() < _LITTLE:
        raise ValueError("expected something of the scene, found nothing there")
    return drawn[region].mean(axis=(0, 1))
