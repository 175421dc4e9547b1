"""Atomic file writes: files are written under a temporary name, then renamed."""

import contextlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path beside `path`, with the same suffix; rename it to `path` if the block succeeds.

    After an exception (Ctrl-C too) the temporary file is removed and an existing file at `path` is unchanged.
    Missing parent folders are created.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id separates concurrent writers; a hidden name keeps partial files out of `ls *.ply`.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None and Path(error.filename) == temporary:
            error.filename = os.fspath(path)  # report the name that the user gave
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_new(paths: Iterable[Path], write: Callable[[Path], None]) -> Path:
    """Write to the first of the paths that does not exist, and return it. Existing files are never
    overwritten, even with concurrent writers, and nothing is left behind if `write` fails.

    Args:
        paths: candidate paths in order; their folder must exist.
        write: writes the file at a given path.

    Raises:
        FileExistsError: all of the paths exist.
    """
    for path in paths:
        try:
            path.open("x").close()  # reserves the name
        except FileExistsError:
            continue
        try:
            write(path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path
    raise FileExistsError("paths: expected one that does not exist yet, found none")


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as JSON. NumPy numbers and arrays become plain numbers and lists; NaN and infinities
    become null, since JSON does not have them and browsers reject files that contain them.

    Raises:
        TypeError: `value` contains something that JSON cannot represent.
    """
    text = json.dumps(_plain(value), indent=2, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_npz(path: str | os.PathLike, arrays: Mapping[str, Any], *, compress: bool = True) -> None:
    """Write named arrays as an .npz that loads with `allow_pickle=False`.

    Args:
        path: the file; missing parent folders are created.
        arrays: the arrays, by name.
        compress: compress the file, which is then smaller but slower to write.

    Raises:
        ValueError: an array holds Python objects, which would require pickle.
    """
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    objects = [name for name, value in arrays.items() if value.dtype.hasobject]
    if objects:
        found = f"Python objects in {objects}"
        raise ValueError(f"write_npz: expected numbers, booleans or strings, found {found}")
    # Written through a stream, because np.savez appends .npz to names without it.
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        (np.savez_compressed if compress else np.savez)(stream, **arrays)


def _plain(value: Any) -> Any:
    """`value` converted to types that `json` supports."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy and JAX arrays and scalars
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value
