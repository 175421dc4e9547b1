"""The meaning of a scene's features: the names that they tell apart, and texts and places among them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.methods.deform.query import prompt_probabilities
from gsjax.methods.deform.questions import plain_words
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.query import Prompt, encoded_prompt

_NEARLY = 0.95  # share of the pixels of a teacher's cell that have to count, for the cell to count


@dataclass(frozen=True, eq=False)
class Meaning:
    """The meaning of features, apart from any frame.

    Attributes:
        source: of the features that were learned, with the encoder that reads texts in their space
            (`gsjax.engine.teaching.source.Source`).
        names: of what the features tell apart: classes, or groups of features that are alike.
        codebook: the feature of each name.
        basis: orthonormal columns that bring the source's vectors of D numbers into the scene's channels.
            Fixed, for two that learn agree best where both are 0.
    """

    source: Any
    names: tuple[str, ...]
    codebook: Float[np.ndarray, "k channels"]
    basis: Float[np.ndarray, "D channels"]

    def hint(self, weights: Path | None = None) -> str:
        """What can be asked for, in words; as `Source.hint`.

        Args:
            weights: folder of CLIP's, where they are now.
        """
        known = self.source.hint(weights)
        return known if self.source.kind == "classes" else f"{known}; or one of: {', '.join(self.names)}"


class Lesson(NamedTuple):
    """A teacher's labels of frames, pixel by pixel.

    Attributes:
        ids: of each frame, the row of the codebook of each of the teacher's pixels, -1 for none; a grid of
            any size, the same in all frames.
        codebook: the teacher's features, in the scene's channels.
        meaning: what these mean; None without names.
    """

    ids: Sequence[Int[np.ndarray, "h w"]]
    codebook: Float[np.ndarray, "n channels"]
    meaning: Meaning | None = None


def counted_ids(
    ids: Int[np.ndarray, "h w"], mask: Bool[np.ndarray, "height width"] | None
) -> Int[np.ndarray, "h w"]:
    """The teacher's ids of pixels that count, and of cells of its grid of which nearly all do, else -1: what
    is behind a tool is not to learn that it is one.

    Args:
        ids: of the teacher's pixels, on a grid of any size.
        mask: the pixels of the picture that count; None if all do.
    """
    if mask is None:
        return ids
    high, wide = ids.shape
    share = cv2.resize(mask.astype(np.float32), (wide, high), interpolation=cv2.INTER_AREA)
    return np.where(share > _NEARLY, ids, -1)


def text_prompt(
    meaning: Meaning,
    text: str,
    negatives: tuple[str, ...] | None = None,
    encoder: Callable[[], LanguageEncoder] | None = None,
) -> Prompt:
    """The prompt of a text: one of the scene's names, or any text that the encoder of its features reads.

    Args:
        meaning: of the scene's features.
        text: of the query.
        negatives: texts to compare with (default: the source's own). Of no use for names.
        encoder: loads the encoder that reads texts (default: the source's own). Not called for names.

    Raises:
        ValueError: no class has the name, no encoder reads texts in these features' space, or options do not
            fit.
        FileNotFoundError: weights are not there.
    """
    if meaning.source.kind == "classes" or plain_words(text) in map(plain_words, meaning.names):
        if negatives is not None:
            raise ValueError("--negatives: a name is compared with the other names; leave it out")
        return _among(meaning, meaning.codebook, _row_of(meaning.names, text))
    try:
        loaded = meaning.source.encoder() if encoder is None else encoder()
    except ValueError as error:
        raise ValueError(f"{error}; or by a name: {', '.join(meaning.names)}") from error
    prompt = encoded_prompt(meaning.source, text, negatives, lambda: loaded)
    if prompt.vectors.shape[1] != len(meaning.basis):
        raise ValueError(
            f"expected texts of {len(meaning.basis)} numbers like these features, found "
            f"{prompt.vectors.shape[1]}: --weights are those of another encoder"
        )
    return prompt._replace(vectors=_of_length_one(prompt.vectors) @ meaning.basis)


def feature_prompt(meaning: Meaning, feature: Float[np.ndarray, "c"]) -> Prompt:
    """The prompt of a feature: it replaces the code that is the most like it, and is compared with the
    others."""
    likely = prompt_probabilities(jnp.asarray(feature), jnp.asarray(meaning.codebook))
    row, vectors = int(np.asarray(likely).argmax()), np.array(meaning.codebook)
    vectors[row] = feature
    return _among(meaning, vectors, row)


def _row_of(names: tuple[str, ...], text: str) -> int:
    """The row of a name; raises a ValueError for a text that is none of them."""
    known, name = [plain_words(one) for one in names], plain_words(text)
    if name not in known:
        raise ValueError(
            f"no class {text!r}; this scene knows names alone, and there are: {', '.join(known)}"
        )
    return known.index(name)


def _among(meaning: Meaning, vectors: Float[np.ndarray, "k c"], row: int) -> Prompt:
    """The vector in a row, compared with the others."""
    others = [other for other in range(len(vectors)) if other != row]
    against = tuple(meaning.names[other] for other in others)
    ordered = _of_length_one(vectors)[[row, *others]]
    return Prompt(ordered, against, meaning.names[row], rule="better than each other name")


def _of_length_one(vectors: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "k c"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
