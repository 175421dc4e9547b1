"""Checkpoints: a pytree in one self-describing .npz, without pickle.

The file holds each array under its path in the tree, and a JSON header with the rest of the tree: containers,
numbers, text, and the type names and fields (static ones included) of NamedTuples, dataclasses and equinox
modules. It is read without a template. Only types of gsjax and of the libraries whose states it stores are
instantiated, and none of their code runs except the checks of dataclasses.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from gsjax.io.arrays import load_arrays
from gsjax.io.atomic import write_npz
from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json

_FORMAT = 2  # 1 needed a template
_HEADER = "__header__"
_LIBRARIES = ("gsjax", "optax", "equinox", "jaxlie")
_QUOTED, _LISTED = 40, 200  # characters of a version, and of names
_ANEW = "start again, or continue with the version that wrote it"


class CheckpointError(ValueError):
    """A checkpoint that is damaged or of another version."""


def save_checkpoint(path: str | os.PathLike, tree: Any, metadata: Mapping[str, Any] | None = None) -> None:
    """Write `tree` and `metadata` to `path`; atomic.

    Args:
        tree: arrays (also random keys and low-precision floats, kept exactly), numbers, text, None, lists,
            tuples, dicts, and NamedTuples, dataclasses and modules of gsjax, optax, equinox and jaxlie.
        metadata: values that JSON can hold.

    Raises:
        TypeError: `tree` holds something else, such as a function, or JSON cannot hold `metadata`.
    """
    encoded, arrays = encode(tree)
    header = {
        "format": _FORMAT,
        "version": import_module("gsjax").__version__,
        "tree": encoded,
        "metadata": dict(metadata or {}),
        "sha256": _checksum(arrays),
    }
    # Uncompressed: compression shrinks an optimizer's floats by only a tenth and takes sixty times as long.
    write_npz(path, arrays | {_HEADER: np.array(json.dumps(header))}, compress=False)


def load_checkpoint(path: str | os.PathLike) -> tuple[Any, dict[str, Any]]:
    """The tree that was saved at `path`, and the metadata.

    Raises:
        FileNotFoundError: there is no file at `path`.
        CheckpointError: the file is damaged, or holds types that this version does not have.
    """
    path = Path(path)
    arrays, header = _read(path)
    try:
        return _decoded(header["tree"], arrays), header["metadata"]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise CheckpointError(
            f"{path}: expected a checkpoint of gsjax {import_module('gsjax').__version__}, found one of "
            f"gsjax {brief(header.get('version'), _QUOTED)} that differs ({brief(error)}); {_ANEW}"
        ) from error


def load_metadata(path: str | os.PathLike) -> dict[str, Any]:
    """The metadata saved at `path`.

    Raises:
        FileNotFoundError: there is no file at `path`.
        CheckpointError: the file is damaged.
    """
    return _read(Path(path))[1]["metadata"]


def encode(tree: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """A tree as JSON (equal for equal trees), and its arrays by path.

    Args, raises: as `save_checkpoint`.
    """
    arrays: dict[str, np.ndarray] = {}
    return _encoded(tree, "", arrays), arrays


def _encoded(node: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """A node as JSON; its arrays are added to `arrays` by their paths."""
    if node is None or isinstance(node, (bool, str)) or type(node) in (int, float):
        return node
    if isinstance(node, (np.ndarray, np.generic, jax.Array)):
        arrays[path], dtype = _to_stored(node)
        kind = "jax" if isinstance(node, jax.Array) else "numpy"
        kind = "scalar" if isinstance(node, np.generic) else kind
        return {"array": path, "dtype": dtype, "kind": kind}
    if isinstance(node, tuple) and hasattr(node, "_fields"):
        return _fields_of(node, node._fields, path, arrays)
    if dataclasses.is_dataclass(node) and not isinstance(node, type):
        names = [field.name for field in dataclasses.fields(node) if hasattr(node, field.name)]
        return _fields_of(node, names, path, arrays)
    if isinstance(node, (list, tuple)):
        items = [_encoded(item, f"{path}[{i}]", arrays) for i, item in enumerate(node)]
        return {"list" if isinstance(node, list) else "tuple": items}
    if isinstance(node, dict):
        keys = [_encoded(key, f"{path}.key{i}", arrays) for i, key in enumerate(node)]
        values = [_encoded(value, f"{path}[{key!r}]", arrays) for key, value in node.items()]
        return {"dict": [list(pair) for pair in zip(keys, values, strict=True)]}
    where = path or "the tree"
    raise TypeError(
        f"checkpoint: {where}: expected arrays, numbers, text, containers or modules, found {node!r}"
    )


def _fields_of(node: Any, names: Any, path: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    dot = f"{path}." if path else ""
    fields = {name: _encoded(getattr(node, name), f"{dot}{name}", arrays) for name in names}
    return {"type": _name_of(type(node)), "fields": fields}


def _name_of(kind: type) -> str:
    """The name by which a type can be found again: "optax:ScaleByAdamState" if the library itself exports it,
    since its submodules may move."""
    library = kind.__module__.split(".")[0]
    if library not in _LIBRARIES:
        raise TypeError(
            f"checkpoint: expected types of {', '.join(_LIBRARIES)}, found {kind.__module__}.{kind.__name__}"
        )
    if library != "gsjax" and getattr(import_module(library), kind.__qualname__, None) is kind:
        return f"{library}:{kind.__qualname__}"
    return f"{kind.__module__}:{kind.__qualname__}"


def _type_named(name: str) -> type:
    """The inverse of `_name_of`.

    Raises:
        ValueError: it is not a type of these libraries, or has no fields.
    """
    module, _, qualified = name.partition(":")
    if module.split(".")[0] not in _LIBRARIES or "__main__" in module:
        raise ValueError(f"type {name}: not of {', '.join(_LIBRARIES)}")
    try:
        kind: Any = import_module(module)
        for part in qualified.split("."):
            kind = getattr(kind, part)
    except (ImportError, AttributeError):
        raise ValueError(f"type {name}: not found") from None
    if not isinstance(kind, type) or not (dataclasses.is_dataclass(kind) or hasattr(kind, "_fields")):
        raise ValueError(f"type {name}: expected a NamedTuple, dataclass or module, found another object")
    return kind


def _decoded(node: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The inverse of `_encoded`."""
    if not isinstance(node, dict):
        return node
    if "array" in node:
        return _from_stored(arrays[node["array"]], node["dtype"], node["kind"])
    if "list" in node:
        return [_decoded(item, arrays) for item in node["list"]]
    if "tuple" in node:
        return tuple(_decoded(item, arrays) for item in node["tuple"])
    if "dict" in node:
        return {_decoded(key, arrays): _decoded(value, arrays) for key, value in node["dict"]}
    kind = _type_named(node["type"])
    return _made(kind, {name: _decoded(value, arrays) for name, value in node["fields"].items()})


def _made(kind: type, fields: dict[str, Any]) -> Any:
    """An instance of a type with these fields.

    Raises:
        ValueError: the type now has other fields.
    """
    is_tuple = hasattr(kind, "_fields")
    names = kind._fields if is_tuple else [field.name for field in dataclasses.fields(kind)]
    others = sorted(set(names) ^ set(fields))
    if others:
        raise ValueError(f"type {kind.__name__}: its fields have changed ({', '.join(others)})")
    if not issubclass(kind, eqx.Module):
        return kind(**fields)
    module = object.__new__(kind)  # as tree_unflatten does, without the checks of __init__
    for name, value in fields.items():
        object.__setattr__(module, name, value)
    return module


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a checkpoint, whose checksum is verified."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, found no file. Check the path")
    try:
        stored = load_arrays(path)
        if _HEADER not in stored:
            names = brief(", ".join(stored), _LISTED) or "nothing by name"
            raise ValueError(f"it holds {names}, which gsjax.save did not write")
        header = parse_json(str(stored.pop(_HEADER)))
        written, intact = header["format"], header["sha256"] == _checksum(stored)
        if not isinstance(header["metadata"], dict):
            raise ValueError("metadata without names")
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{path}: expected a checkpoint, found a file that cannot be read as one ({brief(error)}). "
            "It may be of another kind, truncated or damaged; use another one"
        ) from error
    if written != _FORMAT:
        raise CheckpointError(
            f"{path}: expected a checkpoint of format {_FORMAT}, found format {brief(written)}, written by "
            f"another version of gsjax; {_ANEW}"
        )
    if not intact:
        raise CheckpointError(
            f"{path}: expected a matching checksum, found altered content; use another checkpoint"
        )
    return stored, header


def _is_key(leaf: Any) -> bool:
    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_stored(leaf: Any) -> tuple[np.ndarray, str]:
    """A leaf as an array that .npz can store, and the name of its actual dtype."""
    if _is_key(leaf):
        return np.asarray(jax.random.key_data(leaf)), f"key<{jax.random.key_impl(leaf)}>"
    array = np.asarray(leaf)
    # bfloat16 and the like are not native NumPy dtypes; .npz would store them as raw void bytes.
    plain = array if array.dtype.isbuiltin == 1 else array.view(np.dtype(f"u{array.dtype.itemsize}"))
    return plain, str(array.dtype)


def _from_stored(array: np.ndarray, dtype: str, kind: str) -> Any:
    """The inverse of `_to_stored`: a JAX array, a random key, or an array or number of numpy."""
    if dtype.startswith("key<"):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=dtype[len("key<") : -1])
    if not (array.dtype.isbuiltin == 1 and str(array.dtype) == dtype):
        array = array.view(jnp.dtype(dtype))
    if kind == "scalar":
        return array[()]
    return jax.device_put(array) if kind == "jax" else array


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the names, dtypes, shapes and bytes of arrays, in order of name."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
