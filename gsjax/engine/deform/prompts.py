"""What a text, a point or a box means of a deforming scene, and how well what has features fits it."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.engine.deform.teacher import Meaning
from gsjax.methods.deform.query import like_feature, prompt_cosines
from gsjax.methods.deform.questions import plain_words
from gsjax.methods.distill import Threshold, relevancy, threshold_for
from gsjax.methods.protocols import LanguageEncoder


class Wanted(NamedTuple):
    """What is looked for, and what it is told apart from.

    Attributes:
        vectors: in the scene's channels, a row a candidate: directions, or what the channels have of them.
        row: which of them is asked for.
        meant: the name that it has or is the most like; None of a text that an encoder reads.
        against: the others, in words.
        least: the encoder's own threshold of a cosine; None where it has none.
    """

    vectors: Float[np.ndarray, "k c"]
    row: int
    meant: str | None
    against: tuple[str, ...]
    least: float | None = None

    def scores(self, features: Float[Array, "*n c"]) -> Float[Array, "*n"]:
        """Of Gaussians, or of a picture; higher fits better: the cosine where nothing is told apart, else the
        least share against one of the others, 1/2 where both fit alike (`relevancy`). A share among all of
        them would be small of names that are much alike."""
        order = [self.row, *(row for row in range(len(self.vectors)) if row != self.row)]
        return _scores(features, jnp.asarray(self.vectors[order], jnp.float32))

    def threshold(self, scores: Float[np.ndarray, "n"], given: float | None = None) -> Threshold:
        """Above which score something is meant, and by which rule.

        Args:
            scores: of Gaussians.
            given: by who asks.

        Raises:
            ValueError: no score can be above the given one, or all are.
        """
        least, what = (-1, "a cosine") if len(self.vectors) == 1 else (0, "a share against others")
        if given is not None and not least <= given < 1:
            raise ValueError(f"--threshold: expected {least} to below 1, {what}, found {given:g}")
        if given is None and len(self.vectors) == 1 and self.least is not None:
            return Threshold(self.least, "the encoder's own")
        found = threshold_for(scores, len(self.vectors) > 1, given)
        if given is None and self.meant is not None and len(self.vectors) > 1:
            return found._replace(rule="better than each other name")
        return found


def wanted_text(
    meaning: Meaning,
    text: str,
    negatives: tuple[str, ...] | None = None,
    encoder: Callable[[], LanguageEncoder] | None = None,
) -> Wanted:
    """What a text means: one of the scene's names, or what the encoder of its features reads in it.

    Args:
        meaning: of the scene's features.
        text: what is asked for.
        negatives: texts that it is held against; the source's own unless given. Of no use for names.
        encoder: loads who reads texts; the source's own unless given. Not called for names.

    Raises:
        ValueError: no class has the name, nobody reads texts in these features' space, or options do not fit.
        FileNotFoundError: weights are not there.
    """
    source = meaning.source
    if source.kind == "classes" or plain_words(text) in map(plain_words, meaning.names):
        if negatives is not None:
            raise ValueError("--negatives: a name is held against the other names; leave it out")
        return _among(meaning, meaning.codebook, row_of(meaning.names, text))
    try:
        reader = source.encoder() if encoder is None else encoder()
    except ValueError as error:
        raise ValueError(f"{error}; or by a name: {', '.join(meaning.names)}") from error
    against = source.negatives(text) if negatives is None else negatives
    texts = np.stack([np.asarray(reader.embed_text(one), np.float64) for one in (text, *against)])
    if texts.shape[1] != len(meaning.basis):
        raise ValueError(
            f"expected texts of {len(meaning.basis)} numbers like these features, found {texts.shape[1]}: "
            "--weights are those of another encoder"
        )
    least = reader.min_score if source.kind == "closed" else None
    return Wanted(_of_length_one(texts) @ meaning.basis, 0, None, against, least)


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
    return Wanted(_of_length_one(vectors), row, meaning.names[row], against)


def _of_length_one(vectors: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "k c"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


@jax.jit
def _scores(features: Float[Array, "*n c"], directions: Float[Array, "k c"]) -> Float[Array, "*n"]:
    return relevancy(prompt_cosines(features, directions))
