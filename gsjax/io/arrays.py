"""Loads plain arrays from .npy and .npz files, without unpickling anything or trusting their headers."""

import struct
import tokenize
import zipfile
import zlib
from lzma import LZMAError
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from gsjax.io.brief import brief

# What numpy and zipfile raise for damaged headers, directories and streams.
_DAMAGED = (
    *(ValueError, TypeError, LookupError, AttributeError, SyntaxError, RecursionError, tokenize.TokenError),
    *(ArithmeticError, MemoryError, EOFError, OSError, RuntimeError, struct.error),
    *(zipfile.BadZipFile, zlib.error, LZMAError),
)
_LARGE, _MOST_PACKED = 1 << 30, 100  # bytes; largest compression ratio beyond that
_ZIP = b"PK"


class ArraysError(ValueError):
    """A file does not hold plain arrays; the message briefly says why, and does not name the file."""


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; the array of an .npy file has the name "".

    Args:
        path: the file.

    Raises:
        FileNotFoundError: there is no such file.
        ArraysError: it is cut off or damaged, holds anything but plain arrays, or would unpack to far more
            than its size allows.
    """
    try:
        with path.open("rb") as file:
            start, size = file.read(len(_ZIP)), path.stat().st_size
            file.seek(0)
            if start != _ZIP:
                return {"": _array(file, size)}
            with zipfile.ZipFile(file) as archive:
                return _of_archive(archive, size)
    except FileNotFoundError:
        raise
    except _DAMAGED as error:
        raise ArraysError(brief(error) or type(error).__name__) from error


def _of_archive(archive: zipfile.ZipFile, size: int) -> dict[str, np.ndarray]:
    entries = archive.infolist()
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > max(_LARGE, _MOST_PACKED * size):
        raise ValueError(f"{size} bytes that would unpack to {unpacked}")
    arrays = {}
    for entry in entries:
        with archive.open(entry) as part:
            arrays[entry.filename.removesuffix(".npy")] = _array(part, entry.file_size)
    return arrays


def _array(file: Any, size: int) -> np.ndarray:
    """The array in a stream of `size` bytes, whose header is checked before memory is allocated."""
    version = npy.read_magic(file)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of .npy")
    shape, _, dtype = _HEADERS[version](file)
    needed = dtype.itemsize
    for count in shape:
        needed *= count
    if needed < 0 or (needed > size and not dtype.hasobject):
        raise ValueError(f"{size} bytes for an array of shape {shape} of {dtype}")
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


_HEADERS = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
    (3, 0): npy.read_array_header_2_0,  # differs only in the encoding of field names
}
