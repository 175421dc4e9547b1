"""A random vector per class name: a stand-in for a language model where true labels are known.

In simulation, for example, it measures how well a method carries semantics, without measuring how well a
model recognised them.
"""

import hashlib
import re
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int, Num

DIMENSION = 512  # that of CLIP


class ClassCodebook:
    """Unit vectors of names, identical wherever a name occurs, and nearly orthogonal to each other.

    A name's vector is drawn at random, seeded by the name. The cosine of two is 0 +- 1 / sqrt(dimension).

    Attributes:
        min_score: a query whose best cosine is lower matches none of the objects.
    """

    min_score = 0.5

    def __init__(self, names: Mapping[int, str], dimension: int = DIMENSION):
        """
        Args:
            names: name of each label that masks may hold; other labels are unnamed.
            dimension: length of the vectors.

        Raises:
            ValueError: there are no names, or two labels have the same one.
        """
        if not names:
            raise ValueError("names: expected a name for at least one label, found none")
        self._names = {label: plain_name(name) for label, name in sorted(names.items())}
        if len(set(self._names.values())) < len(self._names):
            raise ValueError(f"names: expected distinct names, found {list(self._names.values())}")
        self._dimension = dimension

    @property
    def names(self) -> tuple[str, ...]:
        """All names in the codebook."""
        return tuple(self._names.values())

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """The vector of the name of each label, 1 to `count`; zeros for a label without a name or pixels.

        Args:
            image: RGB, uint8 or floats 0 to 1. Not used: the labels alone determine the names.
            labels: label of each pixel, 0 for background.
            count: the largest label to embed.
        """
        there = set(np.unique(labels).tolist())
        vectors = np.zeros((count, self._dimension), np.float32)
        for label in range(1, count + 1):
            if label in there and label in self._names:
                vectors[label - 1] = self._vector(self._names[label])
        return vectors

    def embed_text(self, text: str) -> Float[np.ndarray, "D"]:
        """The vector of a name.

        Raises:
            ValueError: it is not one of the names.
        """
        name = plain_name(text)
        if name not in self.names:
            raise ValueError(
                f"no class {text!r}; these features know only names: {', '.join(self.names)}. For "
                "colours: gsjax distill RUN --features closed --out NEW, then gsjax query NEW; or "
                "gsjax query RUN, with a run of gsjax track"
            )
        return self._vector(name)

    def others(self, text: str) -> tuple[str, ...]:
        """All names except this one."""
        return tuple(name for name in self.names if name != plain_name(text))

    def _vector(self, name: str) -> Float[np.ndarray, "D"]:
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
        vector = np.random.default_rng(seed).normal(size=self._dimension)
        return (vector / np.linalg.norm(vector)).astype(np.float32)


def distinct_names(names: Mapping[int, str], rest: Sequence[str]) -> dict[int, str]:
    """Names that tell labels apart: those that differ in case or punctuation at most have the label added, as
    in "cup (3)".

    Args:
        names: the name of each label.
        rest: names for label 0, if it has none; it gets the first that is free.
    """
    taken = {*map(plain_name, names.values())}
    free = next((name for name in rest if plain_name(name) not in taken), rest[0])
    found = {0: free} | {**names}
    while len(uses := Counter(map(plain_name, found.values()))) < len(found):
        found |= {v: f"{name} ({v})" for v, name in found.items() if uses[plain_name(name)] > 1}
    return found


def plain_name(name: str) -> str:
    """The words of a name in lower case, separated by single spaces.

    Args:
        name: the name.
    """
    return " ".join(re.findall(r"[^\W_]+", name.lower()))
