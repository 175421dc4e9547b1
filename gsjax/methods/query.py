"""A query of features: its prompt, the scores of features, and the threshold of scores.

Shared by fields (`gsjax.methods.distill`) and scenes that deform (`gsjax.methods.deform`).
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
"""The threshold against negatives: the query fits better than each of them."""
_LEAST_NORM = 1e-6


class Threshold(NamedTuple):
    """Score above which something is selected, and the rule that it comes from."""

    value: float
    rule: str


class Prompt(NamedTuple):
    """A query in the space of features, and what it is compared with.

    Attributes:
        vectors: the vector of the query, then those that it is compared with, in the channels of the features
            that are scored.
        against: the latter, in words.
        meant: name of what a place or a name means; None for a text that an encoder reads.
        least: the encoder's own threshold of a cosine; None where it has none.
        rule: name of the rule by which the threshold is 1/2.
    """

    vectors: Float[np.ndarray, "q c"]
    against: tuple[str, ...] = ()
    meant: str | None = None
    least: float | None = None
    rule: str = "better than each negative"

    def scores(self, features: Float[Array, "*n c"]) -> Float[Array, "*n"]:
        """Scores of features (of Gaussians, or rendered); higher fits better. See `relevancy`."""
        return _scores(features, jnp.asarray(self.vectors, jnp.float32))

    def threshold(self, scores: Float[np.ndarray, "n"], given: float | None = None) -> Threshold:
        """The score above which something is selected.

        Args:
            scores: of Gaussians.
            given: threshold to use (default: the encoder's own for a text alone, else `threshold_for`).
        """
        compared = len(self.vectors) > 1
        if given is None and self.least is not None and not compared:
            return Threshold(float(self.least), "the encoder's own")
        found = threshold_for(scores, compared, given)
        return found._replace(rule=self.rule) if compared and given is None else found


def encoded_prompt(
    source: Any,
    text: str,
    negatives: tuple[str, ...] | None = None,
    encoder: Callable[[], LanguageEncoder] | None = None,
) -> Prompt:
    """The prompt of a text, by the encoder of some features and in its space.

    Args:
        source: of the features (`gsjax.engine.teaching.source.Source`); None where it is not known.
        text: of the query: "red can".
        negatives: texts to compare with (default: those of the source; none where it is not known).
        encoder: loads the encoder (default: that of the source).

    Raises:
        ValueError: the encoder is not known, or does not read the text.
        FileNotFoundError: the encoder's weights are not there.
    """
    if encoder is None and source is None:
        raise ValueError(
            "encoder: expected one that reads texts in the space of this field's features, found none, "
            "and the source of the features is not known; give one, or use `scores`"
        )
    reader = source.encoder() if encoder is None else encoder()
    if negatives is None:
        negatives = () if source is None else tuple(source.negatives(text))
    vectors = np.stack([np.asarray(reader.embed_text(one), np.float64) for one in (text, *negatives)])
    least = reader.min_score if source is not None and source.kind == "closed" else None
    return Prompt(vectors, tuple(negatives), least=least)


def relevancy(cosines: Float[Array, "*n q"], temperature: float = TEMPERATURE) -> Float[Array, "*n"]:
    """The first query's score: its cosine where it is alone, else its least share against one of the others
    (Kerr et al. 2023, "LERF", section 3.4), 1/2 where both fit equally well. A share among all of them would
    be small where they are much alike.

    Args:
        cosines: those of the query, then those of negatives.
        temperature: difference of cosines at which the shares are e : 1.
    """
    if cosines.shape[-1] == 1:
        return cosines[..., 0]
    ahead = cosines[..., 0] - cosines[..., 1:].max(axis=-1)
    return jax.nn.sigmoid(ahead / temperature)


def threshold_for(
    scores: Float[np.ndarray, "n"], against_negatives: bool, given: float | None = None
) -> Threshold:
    """The given threshold; 1/2 against negatives; else Otsu's, which divides the scores into two classes with
    the least variance within each. On the host.

    Args:
        scores: of Gaussians.
        against_negatives: whether the scores are shares against negatives.
        given: threshold to use (default: by the rules above).
    """
    if given is not None:
        return Threshold(float(given), "given")
    if against_negatives:
        return Threshold(EVEN, "better than each negative")
    scores = scores[np.isfinite(scores)]
    if not len(scores) or scores.max() - scores.min() < 1e-6:
        return Threshold(float("inf"), "Otsu; all scores are alike")
    from skimage.filters import threshold_otsu  # slow to import

    return Threshold(float(threshold_otsu(scores)), "Otsu")


def directions(features: Float[Array, "*n c"]) -> Float[Array, "*n c"]:
    """Features scaled to length 1; 0 for features without length."""
    squared = jnp.sum(features**2, axis=-1, keepdims=True)
    there = squared > _LEAST_NORM**2
    return jnp.where(there, features / jnp.sqrt(jnp.where(there, squared, 1.0)), 0.0)


@jax.jit
def _scores(features: Float[Array, "*n c"], vectors: Float[Array, "q c"]) -> Float[Array, "*n"]:
    return relevancy(directions(features) @ vectors.T)
