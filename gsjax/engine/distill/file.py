"""field.npz: a feature field apart from its scene, to be plugged into it and out again."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from equinox import nn, tree_at
from jaxtyping import Array, Float, Int

from gsjax.engine.distill.source import Source
from gsjax.engine.files import check_arrays, read_arrays
from gsjax.io.atomic import write_npz
from gsjax.methods.distill import FeatureField
from gsjax.scene.feature_grid import FeatureGrid, FeatureGridConfig, Located, locate

NAME = "field.npz"
FOLDER = "field"
"""Within a run, where its field lies."""
_AGAIN = "distil it again with this version of gsjax"
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class StoredField:
    """A field as it lies on disk.

    Attributes:
        field: of a grid, the entries that were trained.
        rows: which entries of the grid those are; None for a vector a Gaussian.
        source: of its features.
        scene: sha256 and number of Gaussians of the scene that it was distilled for, its rasterize_mode, and
            which photographs of it there were, as `gsjax distill` was told.
    """

    field: FeatureField
    rows: Int[np.ndarray, "used"] | None
    source: Source
    scene: Mapping[str, Any]

    def at(self, means: Float[Array, "n 3"]) -> tuple[FeatureField, Located | None]:
        """What queries take: the field, and where Gaussians lie in it.

        Raises:
            ValueError: it has a vector for each Gaussian, and there are others than it was distilled for.
        """
        if self.rows is None:
            count = len(self.field.encoding)
            if count != len(means):
                raise ValueError(f"this field has a vector for each of {count} Gaussians, found {len(means)}")
            return self.field, None
        located = locate(self.field.encoding, means)
        indices = np.asarray(located.indices)
        place = np.minimum(np.searchsorted(self.rows, indices), len(self.rows) - 1)
        # An entry that no Gaussian of the scene touched never learned: it is the row of zeros at the end.
        place = np.where(self.rows[place] == indices, place, len(self.rows))
        table = self.field.encoding.table
        table = jnp.concatenate([table, jnp.zeros((1, table.shape[1]), table.dtype)])
        field = tree_at(lambda f: f.encoding.table, self.field, table)
        return field, located._replace(indices=jnp.asarray(place, jnp.int32))


def write_field(path: Path, stored: StoredField) -> None:
    """Writes it; atomic."""
    field, encoding = stored.field, stored.field.encoding
    about: dict[str, Any] = {"format": _FORMAT, "source": stored.source.plain(), "scene": dict(stored.scene)}
    arrays = {"lift": np.asarray(field.lift)}
    if isinstance(encoding, FeatureGrid):
        assert stored.rows is not None
        about["grid"] = asdict(encoding.config)
        arrays |= {
            "rows": stored.rows,
            "table": np.asarray(encoding.table),
            "bounds": np.array(encoding.bounds),
        }
        for i, layer in enumerate(encoding.layers):
            assert layer.bias is not None
            arrays |= {f"weight_{i}": np.asarray(layer.weight), f"bias_{i}": np.asarray(layer.bias)}
    else:
        arrays["vectors"] = np.asarray(encoding)
    write_npz(path, arrays | {"about": np.array(json.dumps(about))})


def read_field(path: Path) -> StoredField:
    """The inverse of `write_field`.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no field, or numbers in it are not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a field that `gsjax distill` wrote, found no file")
    arrays = read_arrays(path, ("about", "lift"), _AGAIN)
    try:
        about = json.loads(str(arrays["about"]))
        source, scene = Source.of(about["source"]), dict(about["scene"])
        config = FeatureGridConfig(**about["grid"]) if "grid" in about else None
        if about["format"] != _FORMAT:
            raise ValueError(f"format {about['format']}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: about: expected what `gsjax distill` writes, found {error}; {_AGAIN}"
        ) from error
    if config is None:
        _check(path, arrays, {"lift": ("d", "c"), "vectors": ("n", "c")})
        return StoredField(_field(arrays["vectors"], arrays["lift"]), None, source, scene)
    widths = [config.levels * config.features, *[config.hidden] * config.depth]
    shapes: dict[str, tuple[str | int, ...]] = {
        "lift": ("d", "c"),
        "rows": ("used",),
        "table": ("used", config.features),
        "bounds": (2, 3),
    }
    for i, (before, after) in enumerate(zip(widths, [*widths[1:], "c"], strict=True)):
        shapes |= {f"weight_{i}": (after, before), f"bias_{i}": (after,)}
    _check(path, arrays, shapes)
    rows, entries = arrays["rows"], sum(config.entries)
    if not (np.diff(rows) > 0).all() or not 0 <= rows[0] <= rows[-1] < entries:
        raise ValueError(
            f"{path}: rows: expected some of 0 to {entries - 1}, in order, found others; {_AGAIN}"
        )
    grid = FeatureGrid(
        jnp.asarray(arrays["table"]),
        tuple(_layer(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(widths))),
        config,
        tuple(tuple(side) for side in arrays["bounds"].tolist()),
    )
    return StoredField(_field(grid, arrays["lift"]), rows, source, scene)


def _check(path: Path, arrays: Mapping[str, np.ndarray], shapes: Mapping[str, tuple[str | int, ...]]) -> None:
    missing = [name for name in shapes if name not in arrays]
    if missing:
        raise ValueError(f"{path}: expected an array {missing[0]}, found {', '.join(arrays)}; {_AGAIN}")
    check_arrays(path, arrays, shapes, _AGAIN)


def _field(encoding: Any, lift: np.ndarray) -> FeatureField:
    return FeatureField(
        encoding if isinstance(encoding, FeatureGrid) else jnp.asarray(encoding), jnp.asarray(lift)
    )


def _layer(weight: np.ndarray, bias: np.ndarray) -> nn.Linear:
    import jax

    layer = nn.Linear(weight.shape[1], weight.shape[0], key=jax.random.key(0))
    return tree_at(lambda one: (one.weight, one.bias), layer, (jnp.asarray(weight), jnp.asarray(bias)))
