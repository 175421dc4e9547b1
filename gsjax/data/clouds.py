"""Coloured point clouds in the file formats of many tools: PLY, PCD, lines of text, and arrays.

x y z, and colours as red green blue (PLY of most tools), r g b, diffuse_red ... (Agisoft), f_dc_0 ... (3DGS),
or one intensity (laser scanners). Integers are relative to 255 or, if some are larger, to 65535 or the
largest value of their type; floats to 1 or, if some are larger, to 255 or 65535. Alpha and everything else is
ignored.
"""

import re
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.photographs import Cloud
from gsjax.data.text import decoded, fields
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.io.arrays import load_arrays
from gsjax.io.brief import brief, shortened
from gsjax.io.parsed_ply import parse_ply

NAMES = ("sparse_pc.ply", "points3D.ply")
"""Files of points that nerfstudio and 3DGS write beside their poses without naming them there."""

_GREY = 0.5  # for points without a colour
_RGB = ("red", "green", "blue")
_COLORS = (
    _RGB,
    ("r", "g", "b"),
    tuple(f"diffuse_{name}" for name in _RGB),
    tuple(f"scalar_{name}" for name in _RGB),
    tuple(f"f_dc_{i}" for i in range(3)),
    ("intensity",) * 3,
    ("scalar_intensity",) * 3,
)
_OVERSHOOT = 1.5  # floats from 0 to 1 may end a little above 1
_TEXT = (".xyz", ".txt", ".pts", ".csv", ".asc", ".xyzrgb")
_UNITS = re.compile(r"\([^()]*\)|\[[^][]*\]")
_COMPRESSED = "binary_compressed"
_QUOTED = 80  # characters
_PCD_TYPE = re.compile("<[iuf][1248]", re.I)

Columns = Mapping[str, Shaped[np.ndarray, "points"]]


def read_cloud(path: Path) -> Cloud:
    """The points of a file (.ply, .pcd, .npy, or lines of text such as .xyz), grey if it has no colours.
    Points that are not finite are left out, with a DataWarning.

    Raises:
        DataError: the file is missing, truncated, or does not hold points with x, y and z.
    """
    suffix = path.suffix.lower()
    read = _READERS.get(suffix, _read_text if suffix in _TEXT else _read_ply)
    try:
        columns = {name.lower(): column for name, column in read(path).items()}
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        colors = _colors(columns, len(points))
    except (FileNotFoundError, IsADirectoryError):
        advice = "Restore it, or remove the reference to it."
        raise DataError(path, "a point cloud", "no such file", advice) from None
    except (KeyError, ValueError, TypeError, EOFError, OverflowError, MemoryError) as error:
        expected = f"{_KINDS[read]} with x, y, z"
        raise DataError(path, expected, f"something else ({error})", "Fetch it again.") from None
    finite = np.isfinite(points).all(-1) & np.isfinite(colors).all(-1)
    if not finite.all():
        some = f"{(~finite).sum()} of {len(finite)} points"
        warnings.warn(f"{path}: {some} are not finite and are left out", DataWarning, stacklevel=2)
    return Cloud(points[finite], np.clip(colors[finite], 0, 1))


def find_cloud(*folders: Path) -> Path | None:
    """The first file of `NAMES` that lies in one of these folders; None if there is none."""
    choices = (folder / name for folder in folders for name in NAMES)
    return next((choice for choice in choices if choice.is_file()), None)


def _colors(columns: Columns, count: int) -> Float[np.ndarray, "points 3"]:
    """RGB, mostly from 0 to 1."""
    names = next((names for names in _COLORS if all(name in columns for name in names)), None)
    if names is None:
        return np.full((count, 3), _GREY)
    colors = np.stack([columns[name] for name in names], axis=-1)
    if names[0] == "f_dc_0":
        return 0.5 + SH_C0 * colors.astype(np.float64)
    if colors.dtype == np.int8:  # bytes from an exporter without unsigned types
        colors = colors.view(np.uint8)
    return colors.astype(np.float64) / _largest(colors)


def _largest(colors: Shaped[np.ndarray, "points 3"]) -> float:
    """The value of full brightness."""
    highest = np.max(colors, initial=0, where=np.isfinite(colors))
    if np.issubdtype(colors.dtype, np.integer):
        # Exporters also write bytes as wider integers: scaled by their type, all would be black.
        sizes = (255, 65535, np.iinfo(colors.dtype).max)
        return next((size for size in sizes if highest <= size), sizes[-1])
    if highest <= _OVERSHOOT:
        return 1.0
    return next((size for size in (255.0, 65535.0) if highest <= size), float(highest))


def _read_ply(path: Path) -> Columns:
    vertices = parse_ply(path)["vertex"]
    return {prop.name: vertices[prop.name] for prop in vertices.properties}


def _read_npy(path: Path) -> Columns:
    array = next(iter(load_arrays(path).values()), np.zeros(0))
    if array.dtype.names:
        return {name: array[name].ravel() for name in array.dtype.names}
    return _of_table(array)


def _read_text(path: Path) -> Columns:
    """Columns of numbers, named by the line above them if it has x, y and z, else by their order. Other lines
    that do not begin with a number, and a line with only the number of points, are skipped."""
    lines = decoded(path.read_bytes()).split("\n")
    first = next((i for i, line in enumerate(lines) if _is_row(fields(line))), len(lines))
    header = next((line for line in reversed(lines[:first]) if line.strip()), "")
    if first < len(lines) and len(fields(lines[first])) == 1:
        first += 1
    table, names = _numbers(lines[first:]), _names(header)
    if not {*"xyz"} <= set(names):
        return _of_table(table)
    if len(names) != table.shape[1]:
        raise ValueError(f"a header of {len(names)} names above rows of {table.shape[1]} numbers")
    return dict(zip(names, table.T, strict=True))


def _names(header: str) -> list[str]:
    """The columns' names in lower case, without comment characters and without units in brackets."""
    return fields(_UNITS.sub("", header).lstrip("#/% \t").lower())


def _numbers(lines: list[str]) -> Float[np.ndarray, "points columns"]:
    """The rows of numbers. Raises ValueError if there is none, or rows contain words or differ in length."""
    top = next((line for line in lines if line.strip()), "")
    if top:
        with suppress(ValueError):  # plain rows, as `fields` would read them, but much faster
            return np.loadtxt(lines, delimiter="," if "," in top else None, comments=None, ndmin=2)
    rows = [row for line in lines if _is_row(row := fields(line))]
    if not rows:
        raise ValueError("no row of numbers")
    odd = next((row for row in rows if len(row) != len(rows[0])), None)
    if odd is not None:
        raise ValueError(f"rows of {len(rows[0])} numbers, and of {len(odd)}: {' '.join(odd)}")
    return np.array(rows, np.float64)


def _is_row(words: list[str]) -> bool:
    """Whether a line begins with a number."""
    try:
        float(words[0])
    except (ValueError, IndexError):
        return False
    return True


def _of_table(table: Shaped[np.ndarray, "points columns"]) -> Columns:
    """Columns without names: x y z, then an intensity if one or four follow, then r g b; normals are not
    taken for colours, since they have negative values."""
    if table.ndim != 2 or table.shape[1] < 3 or table.dtype.kind not in "fiu":
        raise ValueError(f"an array of shape {table.shape} and type {table.dtype}")
    columns = dict(zip("xyz", table.T, strict=False))
    rest = table[:, 3:]
    if rest.shape[1] in (1, 4):
        columns["intensity"], rest = rest[:, 0], rest[:, 1:]
    triples = (rest[:, i : i + 3] for i in range(0, rest.shape[1] - 2, 3))
    colors = next((triple for triple in triples if not (triple < 0).any()), None)
    return columns | ({} if colors is None else dict(zip(_RGB, colors.T, strict=True)))


def _read_pcd(path: Path) -> Columns:
    """PCL's format: a header of text lines, then points as text or binary; rgb packs three bytes."""
    content = path.read_bytes()
    start = content.find(b"\nDATA ")
    end = content.find(b"\n", start + 1)
    header = content[: end if end >= 0 else len(content)].decode("ascii", "replace")
    words = dict(line.split(maxsplit=1) for line in header.splitlines() if len(line.split()) > 1)
    names = words["FIELDS"].split()
    kinds, sizes = words["TYPE"].split(), words["SIZE"].split()
    types = [f"<{kind}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    if odd := [each for each in types if not _PCD_TYPE.fullmatch(each)]:
        raise ValueError(f"TYPE and SIZE {brief(shortened(odd), _QUOTED)}")
    counts = [int(count) for count in words.get("COUNT", "1 " * len(names)).split()]
    if min(counts, default=1) < 1:
        raise ValueError(f"COUNT {words['COUNT']}")
    fields = [
        (f"{name}_{i}", kind.lower(), (count,))
        for i, (name, kind, count) in enumerate(zip(names, types, counts, strict=True))
    ]
    data, layout, points = words["DATA"].strip(), np.dtype(fields), int(words["POINTS"])
    if data == "binary":
        rows = np.frombuffer(content, layout, count=points, offset=end + 1)
    elif data == "ascii":
        lines = [line.split() for line in content[end + 1 :].decode("ascii").splitlines() if line.strip()]
        edges = np.cumsum([0, *counts])
        rows = np.empty(len(lines), layout)
        for (name, kind, _), first, last in zip(fields, edges, edges[1:], strict=False):
            rows[name] = np.array([line[first:last] for line in lines], np.float64).astype(kind)
    else:
        advice = ", save it as binary" if data == _COMPRESSED else ""
        raise ValueError(f"DATA {data}{advice}")
    columns = {name: rows[field][:, 0] for name, (field, _, _) in zip(names, fields, strict=True)}
    for name in {"rgb", "rgba"} & columns.keys():
        packed = np.ascontiguousarray(columns[name]).view("<u4")
        columns |= {
            color: (packed >> shift & 255).astype(np.uint8)
            for color, shift in zip(_RGB, (16, 8, 0), strict=True)
        }
    return columns


_READERS: dict[str, Callable[[Path], Columns]] = {".ply": _read_ply, ".npy": _read_npy, ".pcd": _read_pcd}
_KINDS = {
    _read_ply: "a PLY file",
    _read_npy: "an array",
    _read_pcd: "a PCD file",
    _read_text: "lines of text",
}
