"""Checkpoints: the arrays of any pytree in one .npz file, with JSON metadata and a checksum, without pickle.

The file holds arrays only, so the structure comes from `like`: a tree of the same structure, with any values.
"""

import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.io.atomic import write_npz

_FORMAT = 1
_HEADER = "__header__"
_SCALARS = (bool, int, float, complex)

Tree = TypeVar("Tree")


class CheckpointError(ValueError):
    """A checkpoint is damaged or does not match the requested tree; the message names the difference."""


def save_checkpoint(path: str | os.PathLike, tree: Any, metadata: Mapping[str, Any] | None = None) -> None:
    """Write the arrays and numbers of `tree`, and `metadata`, to `path`, atomically.

    Other leaves (functions, strings) are not saved: loading takes them from `like`.

    Args:
        path: the file.
        tree: any pytree. Random keys and low-precision floats are stored exactly.
        metadata: JSON-serialisable values.

    Raises:
        TypeError: `metadata` is not JSON-serialisable.
    """
    arrays = {name: _to_stored(leaf) for name, leaf in _named_leaves(tree).items()}
    header = {
        "format": _FORMAT,
        "dtypes": {name: dtype for name, (_, dtype) in arrays.items()},
        "metadata": dict(metadata or {}),
        "sha256": _checksum({name: array for name, (array, _) in arrays.items()}),
    }
    stored = {name: array for name, (array, _) in arrays.items()}
    # Uncompressed: compression shrinks optimizer states by only a tenth but takes sixty times as long.
    write_npz(path, stored | {_HEADER: np.array(json.dumps(header))}, compress=False)


def load_checkpoint(path: str | os.PathLike, like: Tree) -> tuple[Tree, dict[str, Any]]:
    """Load the tree saved at `path`, in the structure of `like`, and the metadata.

    Args:
        path: the file.
        like: a tree with the expected structure, shapes and dtypes (`jax.eval_shape` makes one for free).

    Raises:
        FileNotFoundError: there is no file at `path`.
        CheckpointError: the file is damaged, or leaves are missing, unexpected, or of another shape or dtype.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a checkpoint, found no file. Check the path")
    stored, header = _read(path)
    expected = _named_leaves(like)
    _check_names(path, expected, stored)
    dtypes = header["dtypes"]
    loaded = {name: _from_stored(stored[name], dtypes[name], leaf) for name, leaf in expected.items()}
    differing = [
        f"{name}: expected {_describe(leaf)}, found {_describe(loaded[name])}"
        for name, leaf in expected.items()
        if _describe(loaded[name]) != _describe(leaf)
    ]
    if differing:
        raise CheckpointError(f"{path}: the checkpoint does not fit: {'; '.join(differing)}")
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    merged = [loaded.get(jax.tree_util.keystr(key), leaf) for key, leaf in leaves]
    return jax.tree.unflatten(structure, merged), header["metadata"]


def load_metadata(path: str | os.PathLike) -> dict[str, Any]:
    """The metadata saved at `path`.

    Raises:
        CheckpointError: the file is damaged.
    """
    return _read(Path(path))[1]["metadata"]


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the header of a checkpoint, after its checksum is verified."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = {name: archive[name] for name in archive.files}
        header = json.loads(str(stored.pop(_HEADER)))
        intact = header["format"] == _FORMAT and header["sha256"] == _checksum(stored)
    except (
        zipfile.BadZipFile,
        zlib.error,
        ValueError,
        KeyError,
        TypeError,
        EOFError,
        OSError,
        AttributeError,
    ) as error:
        raise CheckpointError(
            f"{path}: expected a checkpoint, found a file that cannot be read as one ({error}). "
            "It may be cut off or damaged: use another one"
        ) from error
    if not intact:
        raise CheckpointError(
            f"{path}: expected format {_FORMAT} and a matching checksum, found format {header['format']} "
            "or changed content. Use another checkpoint"
        )
    return stored, header


def _check_names(path: Path, expected: Mapping[str, Any], stored: Mapping[str, Any]) -> None:
    missing, unexpected = sorted(expected.keys() - stored.keys()), sorted(stored.keys() - expected.keys())
    if missing or unexpected:
        raise CheckpointError(
            f"{path}: the checkpoint does not fit: missing {missing or 'nothing'}, "
            f"unexpected {unexpected or 'nothing'}. Was it saved with other options?"
        )


def _named_leaves(tree: Any) -> dict[str, Any]:
    """The leaves of a tree that are arrays, array specs or numbers, by their path."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    kept = (np.ndarray, np.generic, jax.Array, jax.ShapeDtypeStruct, *_SCALARS)
    return {jax.tree_util.keystr(key): leaf for key, leaf in leaves if isinstance(leaf, kept)}


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


def _from_stored(array: np.ndarray, dtype: str, like: Any) -> Any:
    """The inverse of `_to_stored`, as the kind of `like` (JAX array, NumPy array, Python number)."""
    if dtype.startswith("key<"):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=dtype[len("key<") : -1])
    array = (
        array if array.dtype.isbuiltin == 1 and str(array.dtype) == dtype else array.view(jnp.dtype(dtype))
    )
    if isinstance(like, _SCALARS) and not isinstance(like, np.generic):
        return array.item() if array.ndim == 0 else array
    return array if isinstance(like, (np.ndarray, np.generic)) else jnp.asarray(array)


def _describe(leaf: Any) -> str:
    """Dtype and shape of an array, or the type of a number."""
    if hasattr(leaf, "dtype"):
        return f"{leaf.dtype}[{','.join(map(str, leaf.shape))}]"
    return type(leaf).__name__


def _checksum(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the names, dtypes, shapes and bytes of arrays, in order of name."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
