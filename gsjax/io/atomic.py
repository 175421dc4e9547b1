"""Files that are there whole or not at all: written under a temporary name, then renamed."""

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
    """Give a temporary path beside `path`, with its suffix; rename it to `path` when the block ends well.

    After an exception (Ctrl-C too) the temporary file is removed and whatever stood at `path` still does.
    Missing parent folders are made.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id keeps two writers apart; a hidden name keeps half a file out of `ls *.ply`.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.filename is not None and Path(error.filename) == temporary:
            error.filename = os.fspath(path)  # the name that the user gave
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_new(paths: Iterable[Path], write: Callable[[Path], None]) -> Path:
    """Write to the first of the paths that nothing has, and return it. None is written over, whoever else
    writes there, and where `write` fails nothing is left.

    Args:
        paths: as many as it may take; their folder is there.
        write: puts a file at a path.
    """
    for path in paths:
        try:
            path.open("x").close()  # the name is ours
        except FileExistsError:
            continue
        try:
            write(path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path
    raise FileExistsError("paths: expected one that nothing has, found none")


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as JSON. numpy numbers and arrays become plain ones; NaN and infinities become null,
    because JSON has none and browsers refuse files that hold them.

    Raises:
        TypeError: `value` holds something that has no JSON form.
    """
    text = json.dumps(_plain(value), indent=2, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def write_npz(path: str | os.PathLike, arrays: Mapping[str, Any], *, compress: bool = True) -> None:
    """Write named arrays as an .npz that loads with `allow_pickle=False`, compressed unless told.

    Args:
        path: the file; its folder has to be there.
        arrays: by name.
        compress: smaller, and slower to write.

    Raises:
        ValueError: an array holds Python objects, which only pickle could store.
    """
    arrays = {name: np.asarray(value) for name, value in arrays.items()}
    objects = [name for name, value in arrays.items() if value.dtype.hasobject]
    if objects:
        raise ValueError(f"write_npz: {objects} hold Python objects; want numbers, booleans or strings")
    # Through a stream, because np.savez appends .npz to names that lack it.
    with atomic_write(path) as temporary, open(temporary, "wb") as stream:
        (np.savez_compressed if compress else np.savez)(stream, **arrays)


def _plain(value: Any) -> Any:
    """`value` in the types that `json` knows."""
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
