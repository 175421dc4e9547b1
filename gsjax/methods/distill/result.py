"""What a distillation is for: a field that answers queries about the Gaussians of its scene."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from dataclasses import field as default
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from gsjax.methods.distill.field import FeatureField, at_means, features_of
from gsjax.methods.distill.query import gaussian_cosines
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.query import encoded_prompt, relevancy
from gsjax.scene.feature_grid import FeatureGrid, Located

FORMAT = 1
"""Format of field.npz."""
_UNKNOWN = {"kind": "files", "names": {}, "weights": None}  # a source of which nothing is known


@dataclass(frozen=True, eq=False)
class DistillResult:
    """A feature field, apart from its scene but for where the Gaussians are.

    Attributes:
        field: the field; of a grid, the entries that were trained.
        rows: which entries of the grid these are; None for a vector per Gaussian.
        source: the encoder of the teacher's features, by which texts are read
            (`gsjax.engine.teaching.source.Source`); None where it is not known.
        scene: the scene that the field was distilled for, as far as it is known: `file`, `sha256`,
            `num_gaussians`, `rasterize_mode` and the options that chose its `photographs`.
        means: centres of the Gaussians to score, metres; None before the scene is there.
    """

    field: FeatureField
    rows: Int[np.ndarray, "active"] | None
    source: Any = None
    scene: Mapping[str, Any] = default(default_factory=dict)
    means: Float[Array, "n 3"] | None = None

    @cached_property
    def placed(self) -> tuple[FeatureField, Located | None]:
        """The field and where the Gaussians at `means` lie in it, as `gaussian_cosines` takes them.

        Raises:
            ValueError: there are no means, or as for `at`.
        """
        if self.means is None:
            raise ValueError("means: expected the centres of the scene's Gaussians, found none; see `at`")
        return self.at(self.means)

    def at(self, means: Float[Array, "n 3"]) -> tuple[FeatureField, Located | None]:
        """The field and where other Gaussians lie in it.

        Args:
            means: centres of the Gaussians, metres.

        Raises:
            ValueError: the field has a vector for each Gaussian, and there are more or fewer of them.
        """
        return at_means(self.field, self.rows, means)

    def features(self) -> Float[Array, "n channels"]:
        """The field's feature of each Gaussian; `field.lift` takes it to the teacher's channels."""
        return features_of(*self.placed)

    def cosines(self, vectors: Float[ArrayLike, "q d"]) -> Float[Array, "n q"]:
        """Cosine of each Gaussian's feature and each vector in the teacher's channels.

        Args:
            vectors: for example what an encoder makes of texts.

        Raises:
            ValueError: the vectors have another number of channels than the teacher's features.
        """
        return _cosines(*self.placed, self._queries(vectors))

    def scores(self, vectors: Float[ArrayLike, "q d"]) -> Float[Array, "n"]:
        """Score of each Gaussian for the first vector, against the others (`relevancy`).

        Args:
            vectors: the vector of the query, then those of negatives, in the teacher's channels.

        Raises:
            ValueError: as for `cosines`.
        """
        return _scores(*self.placed, self._queries(vectors))

    def query(
        self,
        text: str,
        *,
        negatives: tuple[str, ...] | None = None,
        encoder: LanguageEncoder | None = None,
    ) -> Float[Array, "n"]:
        """Score of each Gaussian for a text: the cosine, or the least share against one of the negatives,
        which is above 1/2 where the text fits better than each of them.

        Args:
            text: of the query: "red can".
            negatives: texts to compare with (default: those of the source; none where it is not known).
            encoder: reads texts in the space of the teacher's features (default: that of the source).

        Raises:
            ValueError: the encoder is not known, does not read the text, or made other features.
            FileNotFoundError: the encoder's weights are not there.
        """
        reader = None if encoder is None else lambda: encoder
        return self.scores(encoded_prompt(self.source, text, negatives, reader).vectors)

    def write(self, path: str | os.PathLike) -> None:
        """Write field.npz, which `gsjax query` and `gsjax view` read beside the scene.

        Args:
            path: the file.
        """
        with open(path, "wb") as stream:
            np.savez_compressed(stream, **self._arrays())

    def _arrays(self) -> dict[str, np.ndarray]:
        encoding = self.field.encoding
        source = _UNKNOWN if self.source is None else self.source.plain()
        about: dict[str, Any] = {"format": FORMAT, "source": source, "scene": dict(self.scene)}
        arrays = {"lift": np.asarray(self.field.lift)}
        if isinstance(encoding, FeatureGrid):
            assert self.rows is not None
            about["grid"] = asdict(encoding.config)
            arrays |= {
                "rows": self.rows,
                "table": np.asarray(encoding.table),
                "bounds": np.array(encoding.bounds),
            }
            for i, layer in enumerate(encoding.layers):
                assert layer.bias is not None
                arrays |= {f"weight_{i}": np.asarray(layer.weight), f"bias_{i}": np.asarray(layer.bias)}
        else:
            arrays["vectors"] = np.asarray(encoding)
        return arrays | {"about": np.array(json.dumps(about))}

    def _queries(self, vectors: Float[ArrayLike, "q d"]) -> Float[Array, "q d"]:
        queries = jnp.asarray(vectors, self.field.lift.dtype)
        if queries.shape[1] != self.field.dimension:
            raise ValueError(
                f"expected a query of {self.field.dimension} numbers like this field's features, found "
                f"{queries.shape[1]}: it is of another encoder (--weights)"
            )
        return queries


@jax.jit
def _cosines(field, located, queries):
    return gaussian_cosines(field, located, queries)


@jax.jit
def _scores(field, located, queries):
    return relevancy(gaussian_cosines(field, located, queries))
