"""The result of a distillation: a field that scores the Gaussians of its scene for queries."""

from collections.abc import Mapping
from dataclasses import dataclass
from dataclasses import field as default
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from gsjax.methods.distill.field import FeatureField, features_of
from gsjax.methods.distill.query import cosines_of, directions_of
from gsjax.methods.protocols import LanguageEncoder
from gsjax.methods.query import encoded_prompt, relevancy
from gsjax.scene.feature_grid import FeatureGrid, Located, locate

_BEST, _TIE = 32, 0.02  # best Gaussians that decide the level of a query; largest gap that is a tie


@dataclass(frozen=True, eq=False)
class DistillResult:
    """A feature field, and the centres of the Gaussians of its scene.

    Attributes:
        field: the field; for a grid, with the trained entries only.
        rows: indices of these entries; None for a vector per Gaussian.
        source: source of the teacher's features, with the encoder of texts in their space
            (`gsjax.engine.teaching.source.Source`); None if unknown.
        scene: the scene of the field, as far as it is known: `file`, `sha256`, `num_gaussians`,
            `rasterize_mode` and the options that selected its `photographs`.
        means: centres of the Gaussians to score, metres; None before the scene is loaded.

    A teacher may have features on several levels (`source.levels`: things, their parts, the parts of these),
    whose channels are concatenated. A query is then made on one level, `level`; by default, on the one that
    it fits best.
    """

    field: FeatureField
    rows: Int[np.ndarray, "active"] | None
    source: Any = None
    scene: Mapping[str, Any] = default(default_factory=dict)
    means: Float[Array, "n 3"] | None = None

    def __repr__(self) -> str:
        count = "unknown" if self.means is None else f"{len(self.means):,}"
        kind = getattr(self.source, "kind", "unknown")
        return f"DistillResult({count} Gaussians, features: {kind})"

    @cached_property
    def placed(self) -> tuple[FeatureField, Located | None]:
        """The field and the locations of the Gaussians in it, as `gaussian_cosines` takes them.

        Raises:
            ValueError: there are no means, or as for `at`.
        """
        if self.means is None:
            raise ValueError("means: expected the centres of the scene's Gaussians, found none; see `at`")
        return self.at(self.means)

    def at(self, means: Float[Array, "n 3"]) -> tuple[FeatureField, Located | None]:
        """The field, and the locations in it of Gaussians other than its own.

        Args:
            means: centres of the Gaussians, metres.

        Raises:
            ValueError: the field stores one vector per Gaussian, and there are not as many means as vectors.
        """
        encoding, rows = self.field.encoding, self.rows
        if not isinstance(encoding, FeatureGrid):
            if len(encoding) != len(means):
                raise ValueError(
                    f"means: expected {len(encoding)} centres, one per vector, found {len(means)}"
                )
            return self.field, None
        assert rows is not None
        located = locate(encoding, means)
        indices = np.asarray(located.indices)
        place = np.minimum(np.searchsorted(rows, indices), len(rows) - 1)
        # An entry that surrounds no training Gaussian is the row of zeros at the end.
        place = np.where(rows[place] == indices, place, len(rows))
        table = jnp.pad(encoding.table, ((0, 1), (0, 0)))
        field = eqx.tree_at(lambda f: f.encoding.table, self.field, table)
        return field, located._replace(indices=jnp.asarray(place, jnp.int32))

    def features(self) -> Float[Array, "n channels"]:
        """The field's feature of each Gaussian; `field.lift` maps it to the teacher's channels."""
        return features_of(*self.placed)

    @property
    def levels(self) -> tuple[str, ...]:
        """The levels of the features; none if there is only one."""
        return () if self.source is None else tuple(self.source.levels)

    @property
    def smallest(self) -> str | None:
        """The smallest level; None where there are none."""
        return next(iter(self.levels), None)

    def channels(self, level: str | None) -> slice:
        """The teacher's channels of a level; all of them if there are no levels.

        Args:
            level: name of the level; None where there are none.

        Raises:
            ValueError: there is no such level.
        """
        if level not in (self.levels or (None,)):
            there = ", ".join(self.levels) or "none, as these features have no levels"
            raise ValueError(f"level: expected {there}, found {level}")
        first = 0 if level is None else self._dimension * self.levels.index(level)
        return slice(first, first + self._dimension)

    def direction(self, row: int, level: str | None = None) -> Float[Array, "d"]:
        """The feature of a Gaussian in the teacher's channels, of length 1, or 0 where it has none.

        Args:
            row: index of the Gaussian.
            level: of the feature (default: the smallest).
        """
        directions, lifted = self._directions(level or self.smallest)
        return jnp.matmul(lifted, directions[row], precision="highest")

    def cosines(self, vectors: Float[ArrayLike, "..."], level: str | None = None) -> Float[Array, "n q"]:
        """Cosines of the features of Gaussians and vectors in the teacher's channels.

        Args:
            vectors: vectors [q, d], such as the embeddings of texts.
            level: of the features (default: as `best_level` finds it).

        Raises:
            ValueError: the vectors' number of channels is not the teacher's, or there is no such level.
        """
        queries = self._queries(vectors)
        return cosines_of(*self._directions(level or self.best_level(queries)), queries)

    def scores(self, vectors: Float[ArrayLike, "..."], level: str | None = None) -> Float[Array, "n"]:
        """Score of each Gaussian for the first vector, against the others (`relevancy`).

        Args:
            vectors: the query, then negatives, in the teacher's channels, [q, d].
            level: of the features (default: as `best_level` finds it).

        Raises:
            ValueError: as for `cosines`.
        """
        queries = self._queries(vectors)
        return _scores(*self._directions(level or self.best_level(queries)), queries)

    def best_level(self, vectors: Float[ArrayLike, "..."]) -> str | None:
        """The level whose best Gaussians score highest for a query, as in LangSplat (Qin et al. 2024,
        section 3.4); of several that score about as high, the largest. None if there are no levels.

        Args:
            vectors: the query, then negatives, in the teacher's channels, [q, d].

        Raises:
            ValueError: the vectors' number of channels is not the teacher's.
        """
        queries = self._queries(vectors)
        ahead = {level: float(_best_margin(*self._directions(level), queries)) for level in self.levels}
        most = max(ahead.values(), default=0.0)
        return next((level for level in reversed(ahead) if ahead[level] > most - _TIE), None)

    def query(
        self,
        text: str,
        *,
        negatives: tuple[str, ...] | None = None,
        encoder: LanguageEncoder | None = None,
        level: str | None = None,
    ) -> Float[Array, "n"]:
        """Score of each Gaussian for a text: the cosine, or the smallest share against one of the negatives,
        which is above 1/2 where the text matches better than each of them.

        Args:
            text: the text, such as "red can".
            negatives: texts to compare with (default: those of the source; none if it is unknown).
            encoder: encoder of texts in the space of the teacher's features (default: that of the source).
            level: of the features (default: as `best_level` finds it).

        Raises:
            ValueError: the encoder is unknown, does not read the text, or has another dimension.
            FileNotFoundError: the encoder's weights are missing.
        """
        loaded = None if encoder is None else lambda: encoder
        return self.scores(encoded_prompt(self.source, text, negatives, loaded).vectors, level)

    @property
    def _dimension(self) -> int:
        """Number of the teacher's channels on a level."""
        every, count = self.field.dimension, max(1, len(self.levels))
        if every % count:
            raise ValueError(f"levels: expected {every} channels in {count} equal parts, found a remainder")
        return every // count

    @cached_property
    def _known(self) -> dict[str | None, tuple[Float[Array, "n r"], Float[Array, "d r"]]]:
        return {}

    def _directions(self, level: str | None) -> tuple[Float[Array, "n r"], Float[Array, "d r"]]:
        """All that scores on a level need, computed by the first query."""
        if level not in self._known:
            field, located = self.placed
            of_level = eqx.tree_at(lambda f: f.lift, field, field.lift[self.channels(level)])
            self._known[level] = directions_of(of_level, located)
        return self._known[level]

    def _queries(self, vectors: Float[ArrayLike, "..."]) -> Float[Array, "q d"]:
        queries = jnp.asarray(vectors, self.field.lift.dtype)
        if queries.ndim != 2 or queries.shape[1] != self._dimension:
            raise ValueError(
                f"expected queries [q, {self._dimension}], as long as this field's features, found "
                f"{list(queries.shape)}; use the encoder that the field was distilled from (--weights)"
            )
        return queries


@jax.jit
def _scores(directions, lifted, queries):
    return relevancy(cosines_of(directions, lifted, queries))


@jax.jit
def _best_margin(directions, lifted, queries):
    """By how much the query's cosine exceeds those of its negatives, if any: the mean over the best
    Gaussians, as a single one may score high by chance."""
    cosines = cosines_of(directions, lifted, queries)
    ahead = cosines[:, 0] - (cosines[:, 1:].max(axis=1) if len(queries) > 1 else 0.0)
    return jax.lax.top_k(jnp.nan_to_num(ahead, nan=-2.0), min(_BEST, len(ahead)))[0].mean()
