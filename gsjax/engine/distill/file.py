"""Reading field.npz, the file of a feature field, which is separate from that of its scene. It is written by
`gsjax.write_field`."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from equinox import nn, tree_at

from gsjax.engine.checkpoint import FIELD_FORMAT
from gsjax.engine.files import check_arrays, read_arrays
from gsjax.engine.teaching.source import Source
from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json
from gsjax.methods.distill import DistillResult, FeatureField
from gsjax.scene.feature_grid import FeatureGrid, FeatureGridConfig

NAME = "field.npz"
FOLDER = "field"
"""Folder of a run's field, within the run."""
_AGAIN = "distil it again with this version of gsjax"


def read_field(path: Path) -> DistillResult:
    """The field that `write_field` wrote, without the means of its scene.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it does not hold a field, or holds numbers that are not finite.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a field that `gsjax distill` wrote, found no file")
    arrays = read_arrays(path, ("about", "lift"), _AGAIN)
    try:
        about = parse_json(str(arrays["about"]))
        source, scene = Source.of(about["source"]), dict(about["scene"])
        config = FeatureGridConfig(**about["grid"]) if "grid" in about else None
        if about["format"] != FIELD_FORMAT:
            raise ValueError(f"format {about['format']}")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path}: about: expected what `gsjax distill` writes, found {brief(error)}; {_AGAIN}"
        ) from error
    if len(arrays["lift"]) % max(1, len(source.levels)):
        raise ValueError(
            f"{path}: lift: expected as many rows for each of the levels {', '.join(source.levels)}, found "
            f"{len(arrays['lift'])} in all; {_AGAIN}"
        )
    if config is None:
        check_arrays(path, arrays, {"lift": ("d", "c"), "vectors": ("n", "c")}, _AGAIN)
        return DistillResult(_field(arrays["vectors"], arrays["lift"]), None, source, scene)
    widths = [config.levels * config.features, *[config.hidden] * config.depth]
    shapes: dict[str, tuple[str | int, ...]] = {
        "lift": ("d", "c"),
        "rows": ("used",),
        "table": ("used", config.features),
        "bounds": (2, 3),
    }
    for i, (before, after) in enumerate(zip(widths, [*widths[1:], "c"], strict=True)):
        shapes |= {f"weight_{i}": (after, before), f"bias_{i}": (after,)}
    check_arrays(path, arrays, shapes, _AGAIN)
    rows, entries = arrays["rows"], sum(config.entries)
    if not (np.diff(rows) > 0).all() or not 0 <= rows[0] <= rows[-1] < entries:
        raise ValueError(
            f"{path}: rows: expected increasing numbers from 0 to {entries - 1}, found others; {_AGAIN}"
        )
    grid = FeatureGrid(
        jnp.asarray(arrays["table"]),
        tuple(_layer(arrays[f"weight_{i}"], arrays[f"bias_{i}"]) for i in range(len(widths))),
        config,
        tuple(tuple(side) for side in arrays["bounds"].tolist()),
    )
    return DistillResult(_field(grid, arrays["lift"]), rows, source, scene)


def _field(encoding: Any, lift: np.ndarray) -> FeatureField:
    return FeatureField(
        encoding if isinstance(encoding, FeatureGrid) else jnp.asarray(encoding), jnp.asarray(lift)
    )


def _layer(weight: np.ndarray, bias: np.ndarray) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], key=jax.random.key(0))
    return tree_at(lambda one: (one.weight, one.bias), layer, (jnp.asarray(weight), jnp.asarray(bias)))
