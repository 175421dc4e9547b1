"""Niantic's SPZ: about 10 bytes per Gaussian, and 1 for each coefficient of view-dependent colour.

A header, then one array after the other, little-endian:

    positions    3 x 24 bits, fixed point with as many fractional bits as the header says
    alphas       uint8, 0 to 1
    colours      3 uint8: 255 (0.15 c + 0.5) of the constant harmonic c
    scales       3 uint8: 16 (s + 10) of the logarithm s
    rotations    version 2: x y z as 127.5 (q + 1), with w positive; 3 and 4: index of the largest of x y z w
                 in 2 bits, then the other three in order, a sign and 9 bits of |q| sqrt(2) each
    harmonics    uint8 each, 128 (c + 1), coefficient by coefficient, red green blue

In versions 2 and 3 all of this is one gzip stream; in version 4 a header of 32 bytes is followed by a table
of sizes and one zstandard frame per array. Axes are right, up, back: y and z of a 3DGS PLY point the other
way.
Source: README.md and load-spz.cc in github.com/nianticlabs/spz.
"""

import gzip
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import (
    AGAIN,
    REST_SIZES,
    SH_C0,
    Columns,
    SceneError,
    SceneReport,
    columns_of,
    drawable,
    expect_room,
    gaussians_of,
    to_bytes,
)
from gsjax.scene.gaussians import Gaussians

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
_HEADER = struct.Struct("<4sIIBBBB")
_TABLE = struct.Struct("<4sIIBBBBI12x")  # the header of version 4
_MAX_TRAILING = 1 << 20  # bytes that may follow the arrays: vendor extensions
_COLOR_SCALE = 0.15
_ANTIALIASED = 1
_MOST_FRACTIONAL, _FEWEST_FRACTIONAL = 16, 0
_FLIP = np.array([1.0, -1.0, -1.0])
_FLIP_QUAT = np.array([1.0, 1.0, -1.0, -1.0])
# The coefficients, by band, that change sign when y and z do: those odd in y z.
_FLIP_REST = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1.0])
_BUCKETS = np.array([8] * 3 + [16] * 12)
"""Steps, in 1/128, to which coefficients are rounded so that they compress: 5 bits for the first band, 4 for
the others, as in Niantic's own writer."""


class _Header(NamedTuple):
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int

    def sizes(self) -> tuple[int, ...]:
        """Bytes of each array."""
        rotation = 3 if self.version == 2 else 4
        sizes = (9, 1, 3, 3, rotation, 3 * REST_SIZES[self.degree])
        return tuple(self.count * size for size in sizes)


def read_spz(path: Path) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of an SPZ of version 2, 3 or 4, and the report.

    Args:
        path: the file.

    Raises:
        SceneError: it is not an SPZ, has another version or degree, is cut off, or claims to hold far more
            than its size allows.
    """
    data = path.read_bytes()
    packed, size = data[:2] == GZIP, _HEADER.size
    try:
        head = zlib.decompressobj(31).decompress(data, size) if packed else data[:size]
    except zlib.error as error:
        raise SceneError(path, "a gzip stream", f"a damaged one ({error})", AGAIN) from error
    header = _parse(path, head)
    if header.version == 4:
        arrays = _streams(path, data, header)
    else:
        body = _gunzipped(path, data, header) if packed else data[size:]
        if len(body) < sum(header.sizes()):
            found = f"{len(body)} of {sum(header.sizes())} bytes"
            raise SceneError(path, f"{header.count} Gaussians", found, AGAIN)
        ends = np.cumsum(header.sizes())
        arrays = [body[end - size : end] for end, size in zip(ends, header.sizes(), strict=True)]
    gaussians = gaussians_of(_decode(header, [np.frombuffer(array, np.uint8) for array in arrays]))
    antialiased = bool(header.flags & _ANTIALIASED)
    return drawable(path, f"SPZ {header.version}", gaussians, antialiased=antialiased)


def _parse(path: Path, head: bytes) -> _Header:
    """The header, in the form that all versions share."""
    if len(head) < _HEADER.size or head[:4] != MAGIC:
        raise SceneError(path, f"an SPZ, which starts with {MAGIC!r}", repr(head[:4]), AGAIN)
    _, *fields, _ = _HEADER.unpack(head)
    header = _Header(*fields)
    if header.version not in (2, 3, 4):
        advice = "Export it with another version of its program, or as .ply"
        raise SceneError(path, "version 2, 3 or 4 of SPZ", f"version {header.version}", advice)
    if header.degree >= len(REST_SIZES):
        advice = "Export the scene with spherical harmonics of degree 3 or less"
        raise SceneError(path, "spherical harmonics of degree 0 to 3", f"degree {header.degree}", advice)
    if header.fractional_bits > 23:
        raise SceneError(path, "0 to 23 fractional bits", f"{header.fractional_bits}", AGAIN)
    return header


def _gunzipped(path: Path, data: bytes, header: _Header) -> bytes:
    """What follows the header in a gzip stream, whose checksum is verified."""
    needed = sum(header.sizes())
    expect_room(path, needed, len(data), f"{header.count} Gaussians")
    stream = zlib.decompressobj(31)
    try:
        body = stream.decompress(data, _HEADER.size + needed)
        stream.decompress(stream.unconsumed_tail, _MAX_TRAILING)
    except zlib.error as error:
        raise SceneError(path, "a gzip stream", f"a damaged one ({error})", AGAIN) from error
    if not stream.eof:
        found = "more behind them" if stream.unconsumed_tail else "a gzip stream that ends early"
        raise SceneError(path, f"{header.count} Gaussians and the end of the file", found, AGAIN)
    return body[_HEADER.size :]


def _streams(path: Path, data: bytes, header: _Header) -> list[bytes]:
    """The arrays of version 4."""
    import zstandard

    sizes = [size for size in header.sizes() if size] if header.count else []
    if len(data) < _TABLE.size:
        raise SceneError(path, f"a header of {_TABLE.size} bytes", f"{len(data)} bytes", AGAIN)
    *_, num_streams, table = _TABLE.unpack_from(data)
    entries = struct.Struct(f"<{2 * num_streams}Q")
    if not _TABLE.size <= table <= len(data) - entries.size:
        raise SceneError(path, f"a table of {num_streams} sizes", f"only {len(data)} bytes", AGAIN)
    listed = entries.unpack_from(data, table)
    packed, unpacked = listed[::2], list(listed[1::2])
    if [size for size in unpacked if size] != sizes:
        raise SceneError(path, f"arrays of {sizes} bytes", f"{unpacked}", AGAIN)
    expect_room(path, sum(unpacked), len(data), f"{header.count} Gaussians")
    start, arrays = table + entries.size, []
    for before, after in zip(packed, unpacked, strict=True):
        frame = data[start : start + before]
        start += before
        try:
            array = zstandard.ZstdDecompressor().stream_reader(frame).read(after + 1) if after else b""
        except zstandard.ZstdError as error:
            raise SceneError(path, "zstandard frames", f"a damaged one ({error})", AGAIN) from error
        if len(array) != after:
            found = f"{len(array)} bytes" if len(array) < after else "more"
            raise SceneError(path, f"an array of {after} bytes", found, AGAIN)
        arrays.append(array)
    return [array for array in arrays if array] + [b""] * (len(header.sizes()) - len(sizes))


def _decode(header: _Header, arrays: list[np.ndarray]) -> Columns:
    """The values of six arrays."""
    positions, alphas, colors, scales, rotations, rest = arrays
    count = header.count
    words = np.zeros((count, 3, 4), np.uint8)
    words[:, :, 1:] = positions.reshape(count, 3, 3)  # the high bytes, so that a shift back extends the sign
    means = (words.view("<i4")[:, :, 0] >> 8) / 2.0**header.fractional_bits
    sh0 = (colors.reshape(count, 3) / 255 - 0.5) / _COLOR_SCALE
    quats = (
        _xyz(rotations.reshape(count, 3)) if header.version == 2 else _smallest_three(rotations.view("<u4"))
    )
    bands = REST_SIZES[header.degree]
    rest = (rest.reshape(count, bands, 3) - 128.0) / 128 * _FLIP_REST[:bands, None]
    log_scales = scales.reshape(count, 3) / 16 - 10
    return Columns(means * _FLIP, quats * _FLIP_QUAT, log_scales, alphas / 255, sh0 * SH_C0 + 0.5, rest)


def _xyz(codes: np.ndarray) -> np.ndarray:
    """Quaternions w x y z of version 2."""
    xyz = codes / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.sum(xyz**2, axis=1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _smallest_three(words: np.ndarray) -> np.ndarray:
    """Quaternions w x y z of versions 3 and 4."""
    others = words[:, None] >> np.array([20, 10, 0], np.uint32)
    values = (others & 511) / 511 * np.sqrt(0.5) * np.where(others >> 9 & 1, -1, 1)
    is_largest = np.arange(4) == (words >> 30)[:, None]
    xyzw = np.empty((len(words), 4))
    xyzw[is_largest] = np.sqrt(np.maximum(0, 1 - np.sum(values**2, axis=1)))
    xyzw[~is_largest] = values.ravel()
    return xyzw[:, [3, 0, 1, 2]]


def write_spz(path: Path, gaussians: Gaussians, *, antialiased: bool = False) -> None:
    """Write an SPZ of version 3, atomically.

    Positions have 16 fractional bits (steps of 1/65536), and fewer where the scene reaches beyond 127 units;
    scales are clipped to exp(-10) to exp(5.9), and coefficients of view-dependent colour to -1 to 1.

    Args:
        path: the file.
        gaussians: Gaussians that can all be drawn.
        antialiased: whether the scene was fitted with antialiasing.

    Raises:
        ValueError: a Gaussian is more than 8 million units from the origin.
    """
    columns = columns_of(gaussians)
    farthest = np.abs(columns.means).max(initial=0)
    bits = _MOST_FRACTIONAL
    while farthest * 2.0**bits > 2**23 - 1 and bits > _FEWEST_FRACTIONAL:
        bits -= 1
    if farthest * 2.0**bits > 2**23 - 1:
        raise ValueError(
            f"{path}: expected Gaussians within 8388607 units of the origin, which is all that SPZ has room "
            f"for, found one at {farthest:.3g}; move or scale the scene, or write another format"
        )
    fixed = np.round(columns.means * _FLIP * 2.0**bits).astype("<i4")
    positions = fixed[:, :, None].view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    sh0 = (columns.colors - 0.5) / SH_C0
    bands = columns.rest.shape[1]
    steps = _BUCKETS[:bands, None]
    codes = np.round(columns.rest * _FLIP_REST[:bands, None] * 128) + 128
    arrays = (
        positions,
        to_bytes(columns.opacities),
        to_bytes(sh0 * _COLOR_SCALE + 0.5),
        to_bytes((columns.log_scales + 10) * 16 / 255),
        _packed(columns.quats * _FLIP_QUAT),
        np.clip(np.floor((codes + steps // 2) / steps) * steps, 0, 255).astype(np.uint8),
    )
    flags = _ANTIALIASED if antialiased else 0
    header = _HEADER.pack(MAGIC, 3, gaussians.num, REST_SIZES.index(bands), bits, flags, 0)
    body = b"".join([header, *(array.tobytes() for array in arrays)])
    with atomic_write(path) as temporary:
        temporary.write_bytes(gzip.compress(body, 6, mtime=0))


def _packed(quats: np.ndarray) -> np.ndarray:
    """Quaternions w x y z as words of version 3."""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.argmax(np.abs(xyzw), axis=1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    others = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    codes = (
        np.round(np.abs(others) * np.sqrt(2) * 511).clip(0, 511).astype("<u4")
        | (others < 0).astype("<u4") << 9
    )
    return (largest.astype("<u4") << 30) | codes[:, 0] << 20 | codes[:, 1] << 10 | codes[:, 2]
