"""PlayCanvas's compressed PLY, written by SuperSplat and splat-transform: 16 bytes per Gaussian, plus SH.

Gaussians come in chunks of 256; the last may hold fewer. Element `chunk` has the range of each quantity in
each chunk, element `vertex` four uint32 per Gaussian. In these, an integer k of b bits encodes the fraction
k / (2^b - 1) of a range:

    packed_position  11-10-11    x y z in the scene's unit, from min_x.. to max_x..
    packed_rotation  2-10-10-10  index of the largest of w x y z; the other three, -1/sqrt(2) to 1/sqrt(2)
    packed_scale     11-10-11    log scales, from min_scale_x.. to max_scale_x..
    packed_color     8-8-8-8     red green blue, from min_r.. to max_r.. (older files lack these: 0 to 1);
                                 opacity, 0 to 1

The optional element `sh` has f_rest_* in the order of 3DGS, one byte each. The writer divides [-4, 4] into
256 bins. As in splat-transform, byte k is read as the centre of its bin, 8 ((k + 0.5) / 256 - 0.5), but 0 as
-4 and 255 as 4; so a coefficient of 0 is read back as 1/64. (The PlayCanvas engine reads 8 k / 255 - 4, which
differs by less than 1/64.)

Axes are those of the 3DGS PLY. Source: decompress-ply.ts, compressed-chunk.ts and write-compressed-ply.ts in
github.com/playcanvas/splat-transform.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt32
from plyfile import PlyData, PlyElement

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import Columns, columns_of, spatial_order
from gsjax.scene.gaussians import SH_SIZES, Gaussians, gaussians_from_activated

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
CHUNK_SIZE = 256

_POSITION = ("x", "y", "z")
_SCALE = ("scale_x", "scale_y", "scale_z")
_COLOR = ("r", "g", "b")
_ENDS = ("min", "max")
_BOUNDS = [f"{end}_{name}" for group in (_POSITION, _SCALE) for end in _ENDS for name in group]
_COLOR_BOUNDS = [f"{end}_{name}" for end in _ENDS for name in _COLOR]
_REST_COUNTS = tuple(3 * (size - 1) for size in SH_SIZES[1:])
_REST_VALUES = 8 * ((np.arange(256, dtype=np.float32) + 0.5) / 256 - 0.5)
_REST_VALUES[[0, 255]] = -4, 4  # these also encode clipped values

_ADVICE = "It may be damaged or of another format: export it again (SuperSplat and splat-transform write it)"
_NAN_ADVICE = "One bad Gaussian corrupts its chunk: remove NaN and infinite ones before compressing"

Fault = tuple[str, str, str]
"""What was expected, what was found, and what to do."""


def is_compressed(ply: PlyData) -> bool:
    """Whether the vertices of `ply` have packed properties; `find_fault` checks that none is missing."""
    return not set(PACKED).isdisjoint(ply["vertex"].data.dtype.names or ())


def positions(ply: PlyData) -> Float[np.ndarray, "N 3"]:
    """The positions of the Gaussians of a compressed PLY in which `find_fault` finds nothing, float64."""
    fractions = _fractions(ply["vertex"].data["packed_position"], (11, 10, 11))
    return _in_range(ply["chunk"].data, _POSITION, fractions)


def decompress(ply: PlyData, means: Float[np.ndarray, "N 3"]) -> Gaussians:
    """The Gaussians of a compressed PLY in which `find_fault` finds nothing, float32.

    Colours and opacities are stored after activation, so they (and scales) are clamped by
    `gaussians_from_activated`: stored opacities of 0 and 255 get finite logits.

    Args:
        ply: the file.
        means: its `positions`, perhaps relative to an origin.
    """
    chunks, vertices = ply["chunk"].data, ply["vertex"].data
    log_scales = _fractions(vertices["packed_scale"], (11, 10, 11))
    colors, opacities = np.split(_fractions(vertices["packed_color"], (8, 8, 8, 8)), [3], axis=1)
    if "min_r" in chunks.dtype.names:
        colors = _in_range(chunks, _COLOR, colors)
    with np.errstate(over="ignore"):  # infinite scales are left out later
        scales = np.exp(_in_range(chunks, _SCALE, log_scales))
    return gaussians_from_activated(
        means,
        _quats(vertices["packed_rotation"]),
        scales,
        opacities[:, 0],
        colors,
        shN=_harmonics(ply["sh"].data) if "sh" in ply else None,
    )


def _fractions(words: UInt32[np.ndarray, "N"], bits: tuple[int, ...]) -> Float[np.ndarray, "N parts"]:
    """The low sum(bits) bits of each word as unsigned integers, highest first, scaled to fractions 0 to 1."""
    shifts = sum(bits) - np.cumsum(bits)
    largest = (1 << np.array(bits)) - 1
    return (np.asarray(words)[:, None] >> shifts & largest) / largest


def _in_range(
    chunks: np.ndarray, quantities: tuple[str, ...], fractions: Float[np.ndarray, "N parts"]
) -> Float[np.ndarray, "N parts"]:
    """`fractions` interpolated between min_* and max_* of each Gaussian's chunk."""
    # float64, so that the difference of two float32 cannot overflow
    low, high = (
        np.stack([chunks[f"{end}_{name}"] for name in quantities], axis=1).astype(np.float64) for end in _ENDS
    )
    chunk = np.arange(len(fractions)) // CHUNK_SIZE
    return low[chunk] * (1 - fractions) + high[chunk] * fractions


def _quats(words: UInt32[np.ndarray, "N"]) -> Float[np.ndarray, "N 4"]:
    """Quaternions w x y z. The largest component is not stored: it is positive, and the length is 1."""
    others = np.sqrt(2) * (_fractions(words, (10, 10, 10)) - 0.5)
    is_largest = np.arange(4) == (np.asarray(words) >> 30)[:, None]
    quats = np.empty((len(words), 4))
    quats[is_largest] = np.sqrt(np.maximum(0, 1 - np.sum(others**2, axis=1)))
    quats[~is_largest] = others.ravel()
    return quats


def _harmonics(rows: np.ndarray) -> Float[np.ndarray, "N rest 3"]:
    """shN from the rows of the element `sh`."""
    names = _rest_names(rows)
    values = _REST_VALUES[np.stack([rows[name] for name in names], axis=1)]
    # The file is channel-major, as in 3DGS.
    return values.reshape(len(rows), 3, len(names) // 3).transpose(0, 2, 1)


def _rest_names(rows: np.ndarray) -> list[str]:
    """f_rest_0, f_rest_1, ..., as many as there are properties f_rest_*."""
    return [f"f_rest_{i}" for i in range(sum(name.startswith("f_rest_") for name in rows.dtype.names or ()))]


def _bounds(chunks: np.ndarray) -> list[str]:
    """The properties required of an element `chunk`; those of colours only if it has any of them."""
    has_color = not set(_COLOR_BOUNDS).isdisjoint(chunks.dtype.names or ())
    return [*_BOUNDS, *(_COLOR_BOUNDS if has_color else ())]


def find_fault(ply: PlyData) -> Fault | None:
    """Why `decompress` cannot read `ply`; None if it can."""
    # Each check relies on the previous ones having found nothing.
    return _element_fault(ply) or _count_fault(ply) or _range_fault(ply["chunk"].data)


def _element_fault(ply: PlyData) -> Fault | None:
    """An element or property that is missing or of another type."""
    if "chunk" not in ply:
        found = ", ".join(element.name for element in ply.elements)
        return "an element 'chunk' for packed vertices", f"only elements {found}", _ADVICE
    chunk = ply["chunk"]
    fault = _property_fault(chunk, _bounds(chunk.data), ("float32", "float64"))
    fault = fault or _property_fault(ply["vertex"], PACKED, ("uint32",))
    if fault or "sh" not in ply:
        return fault
    names = _rest_names(ply["sh"].data)
    if len(names) not in _REST_COUNTS:
        counts = ", ".join(map(str, _REST_COUNTS[:-1])) + f" or {_REST_COUNTS[-1]}"
        return f"{counts} properties f_rest_* (degree 1 to 3) in element 'sh'", f"{len(names)}", _ADVICE
    return _property_fault(ply["sh"], names, ("uint8",))


def _property_fault(element: PlyElement, names: Sequence[str], types: Sequence[str]) -> Fault | None:
    """A property of `element` that is missing or has a type other than `types`."""
    dtype = element.data.dtype
    found = dtype.names or ()
    missing = [name for name in names if name not in found]
    if missing:
        expected = f"the properties {', '.join(names)} in element '{element.name}'"
        return expected, f"no {', '.join(missing)} among {', '.join(found) or 'none'}", _ADVICE
    other = [f"{dtype[name].name} {name}" for name in names if dtype[name].name not in types]
    if other:
        return f"{' or '.join(types)} in element '{element.name}'", ", ".join(other), _ADVICE
    return None


def _count_fault(ply: PlyData) -> Fault | None:
    """Elements with inconsistent numbers of rows."""
    count, chunks = ply["vertex"].count, ply["chunk"].count
    needed = -(-count // CHUNK_SIZE)
    if chunks != needed:
        expected = f"{needed} rows of element 'chunk' ({count} Gaussians, {CHUNK_SIZE} per chunk)"
        return expected, f"{chunks}", _ADVICE
    if "sh" in ply and ply["sh"].count != count:
        expected = f"{count} rows of element 'sh' (one per Gaussian)"
        return expected, f"{ply['sh'].count}", _ADVICE
    return None


def _range_fault(chunks: np.ndarray) -> Fault | None:
    """A bound of a chunk that is NaN or infinite."""
    for name in _bounds(chunks):
        bad = np.flatnonzero(~np.isfinite(chunks[name]))
        if bad.size:
            found = f"{name} = {chunks[name][bad[0]]} in chunk {bad[0]} (counted from 0)"
            return "finite bounds in every chunk", found, _NAN_ADVICE
    return None


def write_compressed_ply(
    path: Path, gaussians: Gaussians, *, order: Int[np.ndarray, "N"] | None = None
) -> None:
    """Write a compressed PLY, atomically. Gaussians come in spatial order unless another is given, so that
    chunks are small.

    Coefficients of view-dependent colour are clipped to -4 to 4.

    Args:
        path: the file.
        gaussians: Gaussians that can all be drawn.
        order: their rows in the order of the file.
    """
    columns = columns_of(gaussians)
    order = spatial_order(columns.means) if order is None else order
    columns = Columns(*(value[order] for value in columns))
    chunks = np.empty(-(-gaussians.num // CHUNK_SIZE), [(name, "<f4") for name in [*_BOUNDS, *_COLOR_BOUNDS]])
    packed = np.empty(gaussians.num, [(name, "<u4") for name in PACKED])
    packed["packed_position"] = _words(_ranged(chunks, _POSITION, columns.means), (11, 10, 11))
    packed["packed_scale"] = _words(_ranged(chunks, _SCALE, columns.log_scales), (11, 10, 11))
    colors = _ranged(chunks, _COLOR, columns.colors)
    packed["packed_color"] = _words(np.column_stack([colors, columns.opacities]), (8, 8, 8, 8))
    largest = np.argmax(np.abs(columns.quats), axis=1)[:, None]
    quats = columns.quats * np.where(np.take_along_axis(columns.quats, largest, axis=1) < 0, -1, 1)
    others = quats[np.arange(4) != largest].reshape(-1, 3) * np.sqrt(0.5) + 0.5
    packed["packed_rotation"] = _words(others, (10, 10, 10)) | largest[:, 0].astype(np.uint32) << 30
    elements = [PlyElement.describe(chunks, "chunk"), PlyElement.describe(packed, "vertex")]
    if rest := 3 * columns.rest.shape[1]:
        coefficients = columns.rest.transpose(0, 2, 1).reshape(gaussians.num, rest)
        rows = np.empty(gaussians.num, [(f"f_rest_{i}", "u1") for i in range(rest)])
        for i, column in enumerate(np.clip(np.floor((coefficients / 8 + 0.5) * 256), 0, 255).T):
            rows[f"f_rest_{i}"] = column
        elements.append(PlyElement.describe(rows, "sh"))
    with atomic_write(path) as temporary:
        PlyData(elements, byte_order="<").write(str(temporary))


def _ranged(
    chunks: np.ndarray, quantities: tuple[str, ...], values: Float[np.ndarray, "N parts"]
) -> Float[np.ndarray, "N parts"]:
    """Write each chunk's bounds, and return the values as fractions of them; the inverse of `_in_range`."""
    starts = np.arange(0, len(values), CHUNK_SIZE)
    values = values.astype(np.float32)
    low, high = (ufunc.reduceat(values, starts, axis=0) for ufunc in (np.minimum, np.maximum))
    for end, bounds in (("min", low), ("max", high)):
        for name, column in zip(quantities, bounds.T, strict=True):
            chunks[f"{end}_{name}"] = column
    chunk = np.arange(len(values)) // CHUNK_SIZE
    low, extent = low[chunk].astype(np.float64), (high.astype(np.float64) - low)[chunk]
    return (values - low) / np.where(extent > 0, extent, 1)


def _words(fractions: Float[np.ndarray, "N parts"], bits: tuple[int, ...]) -> UInt32[np.ndarray, "N"]:
    """Fractions 0 to 1 packed into words of the given bits, highest first; the inverse of `_fractions`."""
    shifts = sum(bits) - np.cumsum(bits)
    codes = np.round(np.clip(fractions, 0, 1) * ((1 << np.array(bits)) - 1)).astype(np.uint32)
    return np.bitwise_or.reduce(codes << shifts.astype(np.uint32), axis=1)
