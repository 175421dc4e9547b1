"""What a scene's features mean: the names that they tell apart, and what a text or a place is among them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.methods.deform.query import like_feature, prompt_cosines
from gsjax.methods.deform.questions import plain_words
from gsjax.methods.distill import Threshold, relevancy, threshold_for
from gsjax.methods.protocols import LanguageEncoder

_NEARLY = 0.95  # share of the pixels of a teacher's cell that have to count, for the cell to count


@dataclass(frozen=True, eq=False)
class Meaning:
    """What features mean, apart from any frame.

    Attributes:
        source: what made the features that were learned, which knows the encoder that reads texts in their
            space (`gsjax.engine.teaching.source.Source`).
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


class Wanted(NamedTuple):
    """What is looked for, and what it is held against.

    Attributes:
        vectors: in the scene's channels, a row a candidate: directions, or what the channels have of them.
        row: of the one that is looked for.
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
        """Scores of Gaussians, or of a picture; higher fits better: the cosine where it is held against
        nothing, else the least share against one of the others, 1/2 where both fit alike (`relevancy`). A
        share among all of them would be small of names that are much alike.

        Args:
            features: of Gaussians, or rendered.
        """
        order = [self.row, *(row for row in range(len(self.vectors)) if row != self.row)]
        return _scores(features, jnp.asarray(self.vectors[order], jnp.float32))

    def threshold(self, scores: Float[np.ndarray, "n"], given: float | None = None) -> Threshold:
        """The score above which something is meant, and the rule by which it was chosen.

        Args:
            scores: of Gaussians.
            given: a threshold that was asked for.

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
        text: what is looked for.
        negatives: texts that it is held against (default: the source's own). Of no use for names.
        encoder: loads the encoder that reads texts (default: the source's own). Not called for names.

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
    """What is like a feature, held against the names that are less like it."""
    prompt = like_feature(feature, meaning.codebook)
    return _among(meaning, prompt.vectors, prompt.row)


def row_of(names: tuple[str, ...], text: str) -> int:
    """The row of the name that a text is.

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
