"""OpenEXR pictures with depth in floats, as depth cameras of phones export them.

https://openexr.com/en/latest/OpenEXRFileLayout.html: a header of named attributes, a table with the offset of
each chunk of lines, and the chunks. Header and table are checked here, so that a file that is cut off, or
claims more pixels than any depth camera has, is refused before memory is allocated; the package OpenEXR
decodes the chunks.
"""

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax import extras
from gsjax.data.errors import DataError
from gsjax.data.files import read_complete
from gsjax.io.brief import shortened

MOST_VALUES = 2**24
"""Values of all channels together that a file may claim: 64 MiB, many times what depth cameras have."""

_MAGIC = b"\x76\x2f\x31\x01"
_SHORT_NAMES, _LONG_NAMES = 0, 0x400  # other flags mark tiles, deep pixels and several parts
_LINES = (1, 1, 1, 16, 32, 16, 32, 32, 32, 256)  # per chunk, by compression
_INTEGERS, _FLOATS = 0, {1: np.float16, 2: np.float32}  # channel types
_DEPTHS = ("Z", "Y", "R")
_KIND = "depth in one OpenEXR picture of scan lines"
_FETCH = "Fetch the file again."
_EXPORT = "Export depth again."


class _Header(NamedTuple):
    """A header: size in pixels, lines per chunk, channel types by name, and the offset at which it ends."""

    width: int
    height: int
    lines: int
    channels: dict[str, int]
    end: int


def read_exr_depth(path: Path) -> Float[np.ndarray, "height width"]:
    """The depth in an OpenEXR picture: its only channel or, of several, Z, Y or R. Values are as stored.

    Args:
        path: the file.

    Raises:
        DataError: the file is missing, cut off, larger than a depth camera's, or holds no depth in floats.
        MissingExtra: the package OpenEXR is not installed.
    """
    codec = extras.load("OpenEXR", "record3d", "depth in OpenEXR files")
    content = read_complete(path, _KIND)
    try:
        header = _header(content)
    except (ValueError, IndexError, struct.error, KeyError) as error:
        raise DataError(path, _KIND, f"something else ({error})", _FETCH) from None
    name = _depth_channel(path, header)
    if not _is_complete(content, header):
        raise DataError(path, _KIND, f"a file that is cut off ({len(content)} bytes)", _FETCH)
    try:
        pixels = codec.InputFile(str(path)).channel(name)  # codec.File reports damage on stdout
        depth = np.frombuffer(pixels, _FLOATS[header.channels[name]]).reshape(header.height, header.width)
    except (OSError, RuntimeError, ValueError, TypeError, KeyError) as error:
        raise DataError(path, _KIND, f"bad data ({error})", _FETCH) from None
    return depth.astype(np.float32)


def _depth_channel(path: Path, header: _Header) -> str:
    """The name of the depth channel, after a check that the header is plausible."""
    width, height, channels = header.width, header.height, header.channels
    if min(width, height) < 1 or width * height * max(1, len(channels)) > MOST_VALUES:
        expected = f"depth of at most {MOST_VALUES:,} values"
        raise DataError(path, expected, f"{width}x{height} pixels, {len(channels)} channels", _EXPORT)
    name = next(iter(channels)) if len(channels) == 1 else next((n for n in _DEPTHS if n in channels), None)
    if name is None or channels[name] == _INTEGERS:
        present = f"the channels {shortened(channels)}" if channels else "no channel"
        found = f"integers in {name}" if name else present
        raise DataError(path, f"floats in one channel, or in {', '.join(_DEPTHS)}", found, _EXPORT)
    return name


def _header(content: bytes) -> _Header:
    """The header. Raises ValueError, IndexError, struct.error or KeyError if it is not that of one picture of
    scan lines."""
    if content[:4] != _MAGIC:
        raise ValueError("it does not begin as OpenEXR does")
    if (flags := struct.unpack_from("<I", content, 4)[0] & ~0xFF) not in (_SHORT_NAMES, _LONG_NAMES):
        raise ValueError(f"tiles, deep pixels or several parts: flags {flags:#x}")
    values, at = {}, 8
    while content[at] != 0:
        name, at = _name(content, at)
        _, at = _name(content, at)
        (length,) = struct.unpack_from("<I", content, at)
        values[name] = content[at + 4 : at + 4 + length]
        at += 4 + length
    left, top, right, bottom = struct.unpack("<4i", values["dataWindow"])
    channels = dict(_channels(values["channels"]))
    return _Header(right - left + 1, bottom - top + 1, _LINES[values["compression"][0]], channels, at + 1)


def _channels(content: bytes) -> Iterator[tuple[str, int]]:
    at = 0
    while content[at] != 0:
        name, at = _name(content, at)
        kind, _, across, down = struct.unpack_from("<iIii", content, at)
        if (across, down) != (1, 1):
            raise ValueError(f"{name} has fewer pixels than the picture")
        yield name, kind
        at += 16


def _name(content: bytes, at: int) -> tuple[str, int]:
    """A zero-terminated string, and the offset after it."""
    end = content.index(b"\0", at)
    return content[at:end].decode(), end + 1


def _is_complete(content: bytes, header: _Header) -> bool:
    """Whether all chunks of the table lie within the file."""
    count = math.ceil(header.height / header.lines)
    if header.end + 8 * count > len(content):
        return False
    starts = np.frombuffer(content, "<u8", count, header.end)
    if starts.min() < header.end or starts.max() + 8 > len(content):
        return False
    sizes = (struct.unpack_from("<I", content, int(start) + 4)[0] for start in starts)
    return all(int(start) + 8 + size <= len(content) for start, size in zip(starts, sizes, strict=True))
