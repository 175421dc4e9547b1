"""Queries of features by a prompt: its vectors, the scores, and their threshold. Fields
(`gsjax.methods.distill`) and deforming scenes (`gsjax.methods.deform`) share them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.protocols import LanguageEncoder

TEMPERATURE = 0.1
EVEN = 0.5
"""The threshold with negatives: the query matches better than each of them."""
_LEAST_NORM = 1e-6


class Threshold(NamedTuple):
    """The score above which Gaussians are selected, and the rule that it comes from."""

    value: float
    rule: str


class Prompt(NamedTuple):
    """A prompt and the negatives that it is compared with.

    Attributes:
        vectors: the vector of the prompt, then those of its negatives, in the channels of the features.
        negatives: texts or names of the negatives.
        name: the known name that it is, or is nearest to; None for a text that an encoder reads.
        min_score: the encoder's own threshold on cosines; None if it has none.
        rule: name of the rule by which the threshold is 1/2.
        level: level of the features that they are compared with; None without levels.
    """

    vectors: Float[np.ndarray, "q c"]
    negatives: tuple[str, ...] = ()
    name: str | None = None
    min_score: float | None = None
    rule: str = "better than each negative"
    level: str | None = None

    def scores(self, features: Float[Array, "*n c"]) -> Float[Array, "*n"]:
        """Scores of Gaussians or pixels, higher for a better match; see `relevancy`.

        Args:
            features: features of Gaussians, or rendered ones.
        """
        return _scores(features, jnp.asarray(self.vectors, jnp.float32))

    def threshold(self, scores: Float[np.ndarray, "n"], given: float | None = None) -> Threshold:
        """The score above which Gaussians are selected, and the rule that it comes from: the given one; 1/2
        with negatives; without negatives, the encoder's own or, if it has none, Otsu's, which splits the
        scores into the two classes with the least variance within each. On the host.

        Args:
            scores: scores of all Gaussians.
            given: the user's threshold.

        Raises:
            ValueError: the given threshold selects everything or nothing, whatever the scores.
        """
        alone = len(self.vectors) == 1
        low, what = (-1, "a cosine") if alone else (0, "a share against others")
        if given is not None and not low <= given < 1:
            raise ValueError(f"--threshold: expected {low} to below 1, {what}, found {given:g}")
        if given is not None:
            return Threshold(float(given), "given")
        if not alone:
            return Threshold(EVEN, self.rule)
        if self.min_score is not None:
            return Threshold(float(self.min_score), "the encoder's own")
        return _otsu(scores[np.isfinite(scores)])


def encoded_prompt(
    source: Any,
    text: str,
    negatives: tuple[str, ...] | None = None,
    encoder: Callable[[], LanguageEncoder] | None = None,
) -> Prompt:
    """The prompt of a text: its embedding by the encoder of some features, and those of its negatives.

    Args:
        source: source of the features (`gsjax.engine.teaching.source.Source`); None if unknown.
        text: the text, such as "red can".
        negatives: texts to compare with (default: those of the source; none if it is unknown).
        encoder: loads the encoder of texts (default: that of the source).

    Raises:
        ValueError: the encoder is unknown, or does not read the text.
        FileNotFoundError: the encoder's weights are missing.
    """
    if encoder is None and source is None:
        raise ValueError(
            "encoder: expected one that reads texts in the space of this field's features, found none, "
            "and the source of the features is unknown; pass one, or use `scores`"
        )
    reader = source.encoder() if encoder is None else encoder()
    if negatives is None:
        negatives = () if source is None else tuple(source.negatives(text))
    vectors = np.stack([np.asarray(reader.embed_text(one), np.float64) for one in (text, *negatives)])
    closed = source is not None and source.kind == "closed"
    return Prompt(vectors, tuple(negatives), min_score=reader.min_score if closed else None)


def relevancy(cosines: Float[Array, "*n q"], temperature: float = TEMPERATURE) -> Float[Array, "*n"]:
    """The score of the first query: its cosine without negatives, else its smallest share in a softmax with
    one negative (Kerr et al. 2023, "LERF", section 3.4), 1/2 where both match equally. A softmax over all
    would be small if negatives resemble each other.

    Args:
        cosines: cosines of the query, then those of negatives.
        temperature: difference of cosines at which the shares are e : 1.
    """
    if cosines.shape[-1] == 1:
        return cosines[..., 0]
    ahead = cosines[..., 0] - cosines[..., 1:].max(axis=-1)
    return jax.nn.sigmoid(ahead / temperature)


def _otsu(scores: Float[np.ndarray, "n"]) -> Threshold:
    if not len(scores) or scores.max() - scores.min() < 1e-6:
        return Threshold(float("inf"), "Otsu; all scores are alike")
    from skimage.filters import threshold_otsu  # slow to import

    return Threshold(float(threshold_otsu(scores)), "Otsu")


def directions(features: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    """Features scaled to length 1; 0 for features of length 0."""
    squared = jnp.sum(features**2, axis=-1, keepdims=True)
    there = squared > _LEAST_NORM**2
    return jnp.where(there, features / jnp.sqrt(jnp.where(there, squared, 1.0)), 0.0)


@jax.jit
def _scores(features: Float[Array, "*n c"], vectors: Float[Array, "q c"]) -> Float[Array, "*n"]:
    return relevancy(directions(features) @ vectors.T)
