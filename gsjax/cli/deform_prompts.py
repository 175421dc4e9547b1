"""What a text, a point or a box means of a deforming scene, and how well what has features fits it."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.cli.deform_teacher import Meaning
from gsjax.methods.feature_field import EVEN, Threshold, relevancy, threshold_for
from gsjax.methods.surgical.query import like_feature, prompt_cosines, prompt_probabilities
from gsjax.methods.surgical.questions import plain_words

AMONG_NAMES = "a probability among names"


class Wanted(NamedTuple):
    """What is looked for, and what it is told apart from.

    Attributes:
        vectors: in the scene's channels, a row a candidate.
        row: which of them is asked for.
        meant: the name that it has or is the most like; None of a text that an encoder reads.
        against: the others, in words.
        read: whether vectors are texts as an encoder reads them. They are held against features by cosines
            (`relevancy`): of a text and a picture these are small, so shares among them would say little.
        least: the encoder's own threshold of a cosine; None where it has none.
    """

    vectors: Float[np.ndarray, "k c"]
    row: int
    meant: str | None
    against: tuple[str, ...]
    read: bool = False
    least: float | None = None

    def scores(self, features: Float[Array, "*n c"]) -> Float[Array, "*n"]:
        """Of Gaussians, or of a picture; higher fits better."""
        return _scores(features, jnp.asarray(self.vectors, jnp.float32), self.row, self.read)

    def threshold(self, scores: Float[np.ndarray, "n"], given: float | None = None) -> Threshold:
        """Above which score something is meant, and by which rule.

        Args:
            scores: of Gaussians.
            given: by who asks.
        """
        if given is None and self.read and len(self.vectors) == 1 and self.least is not None:
            return Threshold(self.least, "the encoder's own")
        if self.read:
            return threshold_for(scores, len(self.vectors) > 1, given)
        return Threshold(EVEN if given is None else given, AMONG_NAMES)


def wanted_text(
    meaning: Meaning, text: str, negatives: tuple[str, ...] | None = None, weights: Path | None = None
) -> Wanted:
    """What a text means: a class by its name; of other features what their encoder reads in it.

    Args:
        meaning: of the scene's features.
        text: what is asked for.
        negatives: texts that it is held against; the source's own unless given. Of no use for classes.
        weights: of CLIP, where they are now.

    Raises:
        ValueError: no class has the name, nobody reads texts in these features' space, or options do not fit.
        FileNotFoundError: weights are not there.
    """
    source = meaning.source
    if source.kind == "classes":
        for option, given in (("negatives", negatives), ("weights", weights)):
            if given is not None:
                raise ValueError(f"--{option}: this scene knows classes by their names; leave it out")
        return _among(meaning, meaning.codebook, row_of(meaning.names, text))
    encoder = source.encoder(weights)
    against = source.negatives(text) if negatives is None else negatives
    texts = np.stack([np.asarray(encoder.embed_text(one), np.float64) for one in (text, *against)])
    if texts.shape[1] != len(meaning.basis):
        raise ValueError(
            f"expected texts of {len(meaning.basis)} numbers like these features, found {texts.shape[1]}: "
            "--weights are those of another encoder"
        )
    texts /= np.maximum(np.linalg.norm(texts, axis=1, keepdims=True), 1e-12)
    least = encoder.min_score if source.kind == "closed" else None
    return Wanted(texts @ meaning.basis, 0, None, against, True, least)


def wanted_like(meaning: Meaning, feature: Float[np.ndarray, "c"]) -> Wanted:
    """What is like a feature, told apart from the names that are less like it."""
    prompt = like_feature(feature, meaning.codebook)
    return _among(meaning, prompt.vectors, prompt.row)


def row_of(names: tuple[str, ...], text: str) -> int:
    """Which of the names a text is.

    Raises:
        ValueError: it is none of them.
    """
    known, wanted = [plain_words(name) for name in names], plain_words(text)
    if wanted not in known:
        raise ValueError(
            f"no class {text!r}; this scene knows names alone, and there are: {', '.join(known)}"
        )
    return known.index(wanted)


def _among(meaning: Meaning, vectors: Float[np.ndarray, "k c"], row: int) -> Wanted:
    against = tuple(name for other, name in enumerate(meaning.names) if other != row)
    return Wanted(vectors, row, meaning.names[row], against)


@partial(jax.jit, static_argnums=3)
def _scores(
    features: Float[Array, "*n c"], vectors: Float[Array, "k c"], row: int | Array, read: bool
) -> Float[Array, "*n"]:
    if read:
        return relevancy(prompt_cosines(features, vectors))
    return prompt_probabilities(features, vectors)[..., row]
