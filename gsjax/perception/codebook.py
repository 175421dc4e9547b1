"""A vector for each name: what words and things have in common where nobody reads or sees.

The stand-in for a model of language where the labels of things are known, as in simulation: it tells how far
a method carries meaning, and nothing about how well meaning was read.
"""

import hashlib
import re
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int, Num

DIMENSION = 512  # as CLIP's


class ClassCodebook:
    """Unit vectors of names, the same wherever a name occurs, and nearly at right angles to each other.

    A name's vector is drawn at random, seeded by the name. Of two, the cosine is 0 +- 1 / sqrt(dimension).

    Attributes:
        min_score: a query whose best cosine is less means none of the objects.
    """

    min_score = 0.5

    def __init__(self, names: Mapping[int, str], dimension: int = DIMENSION):
        """
        Args:
            names: of the labels that masks may hold; other labels are nothing that has a name.
            dimension: of the vectors.

        Raises:
            ValueError: there are no names, or two labels have the same one.
        """
        if not names:
            raise ValueError("names: expected those of labels, found none")
        self._names = {label: _plain(name) for label, name in sorted(names.items())}
        if len(set(self._names.values())) < len(self._names):
            raise ValueError(f"names: got {list(self._names.values())}, want each of them once")
        self._dimension = dimension

    @property
    def names(self) -> tuple[str, ...]:
        """All names that it knows."""
        return tuple(self._names.values())

    def embed_objects(
        self, image: Num[np.ndarray, "H W 3"], labels: Int[np.ndarray, "H W"], count: int
    ) -> Float[np.ndarray, "count D"]:
        """The vector of the name of each label, 1 to `count`; zeros for one without a name or a pixel.

        Args:
            image: RGB, uint8 or floats 0 to 1. It is not looked at: labels alone say which names.
            labels: of its pixels, 0 the background.
            count: the largest label that is asked for.
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
            ValueError: it is none of the names.
        """
        name = _plain(text)
        if name not in self.names:
            raise ValueError(
                f"no class {text!r}; these features know names alone, and there are: "
                f"{', '.join(self.names)}. For colours: gsjax distill RUN --features closed --out NEW, then "
                "gsjax query NEW; or gsjax query RUN, where RUN is of gsjax track"
            )
        return self._vector(name)

    def others(self, text: str) -> tuple[str, ...]:
        """All names but this one."""
        return tuple(name for name in self.names if name != _plain(text))

    def _vector(self, name: str) -> Float[np.ndarray, "D"]:
        seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little")
        vector = np.random.default_rng(seed).normal(size=self._dimension)
        return (vector / np.linalg.norm(vector)).astype(np.float32)


def _plain(name: str) -> str:
    """Words in lower case, one space between them."""
    return " ".join(re.findall(r"[^\W_]+", name.lower()))
