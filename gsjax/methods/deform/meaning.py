"""The vocabulary of a scene's features: named codes, and prompts from a text or a feature."""

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

_LEAST_SHARE = 0.95  # of the pixels of a teacher's cell that must count for the cell to count


@dataclass(frozen=True, eq=False)
class Meaning:
    """The meaning of a scene's features, the same in all frames.

    Attributes:
        source: source of the teacher's features, with the encoder of texts in their space
            (`gsjax.engine.teaching.source.Source`).
        names: names of classes, or of clusters of features.
        codebook: the feature of each name.
        basis: orthonormal columns that map the source's vectors of D numbers to the scene's channels. They
            are fixed: if both sides were trained, zeros would fit best.
    """

    source: Any
    names: tuple[str, ...]
    codebook: Float[np.ndarray, "k channels"]
    basis: Float[np.ndarray, "D channels"]

    def hint(self, weights: Path | None = None) -> str:
        """A sentence on the texts that can be queried; see `Source.hint`.

        Args:
            weights: current folder of CLIP's weights.
        """
        known = self.source.hint(weights)
        return known if self.source.kind == "classes" else f"{known}; or one of: {', '.join(self.names)}"


class Lesson(NamedTuple):
    """A teacher's per-pixel labels of frames.

    Attributes:
        ids: row of the codebook of each of the teacher's pixels, for each frame; -1 for none. The grid may
            have any size, the same in all frames.
        codebook: the teacher's features, in the scene's channels.
        meaning: names of the features; None without names.
    """

    ids: Sequence[Int[np.ndarray, "h w"]]
    codebook: Float[np.ndarray, "n channels"]
    meaning: Meaning | None = None


def counted_ids(
    ids: Int[np.ndarray, "h w"], mask: Bool[np.ndarray, "height width"] | None
) -> Int[np.ndarray, "h w"]:
    """The teacher's ids where (nearly) all pixels of a cell of its grid count, else -1, so that tissue behind
    a tool is not labelled as tool.

    Args:
        ids: ids of the teacher's cells, a grid of any size.
        mask: the pixels of the image that count; None if all do.
    """
    if mask is None:
        return ids
    high, wide = ids.shape
    share = cv2.resize(mask.astype(np.float32), (wide, high), interpolation=cv2.INTER_AREA)
    return np.where(share > _LEAST_SHARE, ids, -1)


def text_prompt(
    meaning: Meaning,
    text: str,
    negatives: tuple[str, ...] | None = None,
    encoder: Callable[[], LanguageEncoder] | None = None,
) -> Prompt:
    """The prompt of a text: the code of one of the scene's names, or the text's embedding by the encoder of
    the scene's features.

    Args:
        meaning: meaning of the scene's features.
        text: the text.
        negatives: texts to compare with (default: the source's own). Not allowed with names, whose negatives
            are the other names.
        encoder: loads the encoder of texts (default: the source's own). Not called for names.

    Raises:
        ValueError: no class has the name, no encoder reads texts in the space of these features, or it has
            another dimension, or negatives are given for a name.
        FileNotFoundError: the encoder's weights are missing.
    """
    if meaning.source.kind == "classes" or plain_words(text) in map(plain_words, meaning.names):
        if negatives is not None:
            raise ValueError(
                "--negatives: the name of a class is compared with the other names; leave --negatives out"
            )
        return _name_prompt(meaning, meaning.codebook, _row_of(meaning.names, text))
    try:
        loaded = meaning.source.encoder() if encoder is None else encoder()
    except ValueError as error:
        raise ValueError(f"{error}; or by a name: {', '.join(meaning.names)}") from error
    prompt = encoded_prompt(meaning.source, text, negatives, lambda: loaded)
    if prompt.vectors.shape[1] != len(meaning.basis):
        raise ValueError(
            f"expected texts of {len(meaning.basis)} numbers as in these features, found "
            f"{prompt.vectors.shape[1]}: --weights are those of another encoder"
        )
    return prompt._replace(vectors=_normalized(prompt.vectors) @ meaning.basis)


def feature_prompt(meaning: Meaning, feature: Float[np.ndarray, "c"]) -> Prompt:
    """The prompt for a feature, which replaces the code most similar to it; the other codes are its
    negatives."""
    codebook = np.array(meaning.codebook)
    row = int(np.asarray(prompt_probabilities(jnp.asarray(feature), jnp.asarray(codebook))).argmax())
    codebook[row] = feature
    return _name_prompt(meaning, codebook, row)


def _row_of(names: tuple[str, ...], text: str) -> int:
    known, wanted = [plain_words(name) for name in names], plain_words(text)
    if wanted not in known:
        raise ValueError(
            f"no class {text!r}; this scene can be queried by its names only: {', '.join(known)}"
        )
    return known.index(wanted)


def _name_prompt(meaning: Meaning, vectors: Float[np.ndarray, "k c"], row: int) -> Prompt:
    """The prompt for the name in one row of `vectors`; the other rows are its negatives."""
    others = [other for other in range(len(vectors)) if other != row]
    negatives = tuple(meaning.names[other] for other in others)
    ordered = _normalized(vectors)[[row, *others]]
    return Prompt(ordered, negatives, meaning.names[row], rule="better than each other name")


def _normalized(vectors: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "k c"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
