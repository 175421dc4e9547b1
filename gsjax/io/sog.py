"""PlayCanvas's SOG, version 2: 8-bit pictures, and a meta.json that says what they mean, in a zip or a
folder. Each pixel of a picture is a Gaussian, row by row.

    means_l, means_u   low and high byte of x y z: 65535 steps between mins and maxs of sign(x) log(1 + |x|)
    scales             three indices into a codebook of 256 logarithms
    quats              three components, 255 (q sqrt(2) + 1) / 2, without the largest of w x y z; alpha is 252
                       plus the index of the largest
    sh0                three indices into a codebook of the constant harmonic; alpha is the opacity
    shN_labels         low and high byte of an index into a palette of the other harmonics
    shN_centroids      that palette, 64 entries a row, a pixel per coefficient: indices into a codebook

Axes are those of the 3DGS PLY. Pictures are lossless WebP. Source: "The SOG format" at
developer.playcanvas.com, read-sog.ts and write-sog.ts in github.com/playcanvas/splat-transform.
"""

import io
import json
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Int, UInt8

from gsjax.io.atomic import atomic_write
from gsjax.io.codebooks import codebook, nearest, palette
from gsjax.io.parsed import parse_json
from gsjax.io.pictures import PictureError, pillow_errors
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
    spatial_order,
    to_bytes,
)
from gsjax.scene.gaussians import Gaussians

MAGIC = b"PK"
_META = "meta.json"
_MOST_TEXT = 1 << 24
_LONGEST_NAME = 255
_PALETTE_ROW = 64
_MOST_PALETTE = 1 << 16
_LARGEST = 252
"""Alpha of a rotation whose largest component is w."""
_DAMAGED = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError, ValueError)
"""What zipfile raises for a file that is no zip, is encrypted, or uses an unknown compression method."""

Load = Callable[[str], bytes]


def is_meta(path: Path) -> bool:
    """Whether a file is the meta.json of a SOG in a folder, judging by its content.

    Args:
        path: the file, which need not exist.
    """
    if path.name != _META or not path.is_file():
        return False
    with path.open("rb") as stream:
        text = stream.read(_MOST_TEXT)
    try:
        found = parse_json(text)
    except ValueError:
        return False
    return isinstance(found, dict) and {"means", "scales", "quats", "sh0"} <= found.keys()


def read_sog(path: Path) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of a .sog, or of a meta.json with its pictures beside it, and the report.

    Args:
        path: the file.

    Raises:
        SceneError: it is not SOG version 2, or is cut off; a picture is missing, too small for the Gaussians
            or far larger than its file allows; or a name leads out of the archive or folder.
    """
    if path.suffix.lower() == ".json":
        return _read(path, lambda name: _beside(path, name))
    with path.open("rb") as stream:
        return _of_zip(path, stream)


def _of_zip(path: Path, stream: BinaryIO) -> tuple[Gaussians, SceneReport]:
    try:
        with zipfile.ZipFile(stream) as archive:
            return _read(path, lambda name: _member(path, archive, name))
    except SceneError:
        raise
    except _DAMAGED as error:
        found = f"a file that cannot be unpacked ({error})"
        raise SceneError(path, "a zip of pictures and meta.json", found, AGAIN) from error


def _beside(path: Path, name: str) -> bytes:
    file = path if name == _META else path.parent / name
    if not file.is_file():
        raise SceneError(path, f"{name} beside it", "no such file", AGAIN)
    return file.read_bytes()


def _member(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError:
        names = ", ".join(sorted(archive.namelist())[:8]) or "nothing"
        raise SceneError(path, f"{name} in it", names, "A .sog is a zip with meta.json at its root") from None
    expect_room(path, info.file_size, info.compress_size, name)
    with archive.open(info) as stream:
        return stream.read(info.file_size)


class _Meta:
    """The values of a meta.json, each of which is checked when it is read."""

    def __init__(self, path: Path, text: bytes):
        self.path = path
        try:
            self._values = parse_json(text[:_MOST_TEXT])
        except ValueError as error:
            raise SceneError(path, f"JSON in {_META}", f"other text ({error})", AGAIN) from error

    def get(self, *keys: str, default: Any = None) -> Any:
        value = self._values
        for key in keys:
            value = value.get(key, default) if isinstance(value, dict) else default
        return value

    def whole(self, *keys: str, most: int) -> int:
        value = self.get(*keys)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
            raise self._fault(keys, f"a whole number, 0 to {most}", value)
        return value

    def codebook(self, key: str) -> np.ndarray:
        """256 numbers. The first may be null, as splat-transform wrote it for scenes with NaN; it continues
        the others as in PlayCanvas's engine."""
        found = self.numbers(key, "codebook", count=256, first=1)
        if not np.isfinite(found[0]):
            found[0] = found[1] + (found[1] - found[255]) / 255
        return found

    def numbers(self, *keys: str, count: int, first: int = 0) -> np.ndarray:
        """`count` numbers, finite from the `first` one on."""
        value = self.get(*keys)
        try:
            found = np.asarray(value, np.float64)
        except (TypeError, ValueError):
            found = np.zeros(0)
        if found.ndim != 1 or len(found) < count or not np.isfinite(found[first:count]).all():
            raise self._fault(keys, f"{count} finite numbers", value)
        return found[:count]

    def names(self, *keys: str, count: int) -> list[str]:
        """`count` names of files in the same folder."""
        value = self.get(*keys)
        if not isinstance(value, list) or len(value) < count or not all(isinstance(n, str) for n in value):
            raise self._fault(keys, f"{count} names of files", value)
        for name in value[:count]:
            if name != Path(name).name or "\\" in name or name in ("", ".", ".."):
                raise self._fault(keys, "names of files without a folder", name)
            if len(name) > _LONGEST_NAME or "\0" in name:
                raise self._fault(keys, "names of files", name)
        return value[:count]

    def _fault(self, keys: tuple[str, ...], expected: str, value: Any) -> SceneError:
        found = repr(value)
        found = found if len(found) <= 60 else f"{found[:60]}..."
        return SceneError(self.path, f"{expected} as {'.'.join(keys)} in {_META}", found, AGAIN)


def _read(path: Path, load: Load) -> tuple[Gaussians, SceneReport]:
    meta = _Meta(path, load(_META))
    if meta.get("version") != 2:
        found = f"version {meta.get('version')!r}"
        advice = "Convert it with a present version of splat-transform"
        raise SceneError(path, "version 2 of SOG", found, advice)
    count = meta.whole("count", most=1 << 28)

    def pixels(name: str) -> UInt8[np.ndarray, "N 4"]:
        found = _picture(path, name, load(name)).reshape(-1, 4)
        if len(found) < count:
            raise SceneError(path, f"{count} pixels in {name}, one a Gaussian", f"{len(found)}", AGAIN)
        return found[:count]

    low, high = (pixels(name)[:, :3].astype(np.float64) for name in meta.names("means", "files", count=2))
    mins, maxs = (meta.numbers("means", end, count=3) for end in ("mins", "maxs"))
    logs = mins + (low + 256 * high) / 65535 * (maxs - mins)
    with np.errstate(over="ignore"):
        means = np.sign(logs) * np.expm1(np.abs(logs))
    scales, colors, quats = (pixels(*meta.names(key, "files", count=1)) for key in ("scales", "sh0", "quats"))
    log_scales = meta.codebook("scales")[scales[:, :3]]
    sh0 = meta.codebook("sh0")[colors[:, :3]]
    rest = np.zeros((count, 0, 3)) if not meta.get("shN") else _rest(meta, load, pixels)
    columns = Columns(means, _quats(quats), log_scales, colors[:, 3] / 255, sh0 * SH_C0 + 0.5, rest)
    said = meta.get("antialias")
    antialiased = said if isinstance(said, bool) else None
    return drawable(path, "SOG 2", gaussians_of(columns), antialiased=antialiased)


def _picture(path: Path, name: str, data: bytes) -> UInt8[np.ndarray, "H W 4"]:
    """A picture as RGBA, whose size is checked before it is decoded."""
    from PIL import Image

    try:
        with pillow_errors(), warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is checked here
            picture = Image.open(io.BytesIO(data), formats=("WEBP", "PNG"))
        expect_room(path, 4 * picture.width * picture.height, len(data), name)
        with pillow_errors():
            return np.asarray(picture.convert("RGBA"))
    except PictureError as error:
        found = f"data that cannot be decoded ({error})"
        raise SceneError(path, f"a WebP or PNG picture as {name}", found, AGAIN) from error


def _quats(pixels: UInt8[np.ndarray, "N 4"]) -> np.ndarray:
    """Quaternions w x y z; zero where alpha names no component, so that such a Gaussian is left out."""
    others = (pixels[:, :3] / 255 * 2 - 1) * np.sqrt(0.5)
    is_largest = np.arange(4) == pixels[:, 3:].astype(int) - _LARGEST
    known = is_largest.any(axis=1)
    is_largest[~known, 0] = True
    quats = np.empty((len(pixels), 4))
    quats[is_largest] = np.sqrt(np.maximum(0, 1 - np.sum(others**2, axis=1)))
    quats[~is_largest] = others.ravel()
    return np.where(known[:, None], quats, 0)


def _rest(meta: _Meta, load: Load, pixels: Callable[[str], np.ndarray]) -> np.ndarray:
    """View-dependent colour, [N,K-1,3]."""
    bands = REST_SIZES[meta.whole("shN", "bands", most=3)]
    entries = meta.whole("shN", "count", most=_MOST_PALETTE)
    centroids, labels = meta.names("shN", "files", count=2)
    values = meta.codebook("shN")
    table = _picture(meta.path, centroids, load(centroids))
    rows = -(-entries // _PALETTE_ROW)
    if table.shape[1] != _PALETTE_ROW * bands or table.shape[0] < rows:
        expected = f"{_PALETTE_ROW * bands} x {rows} pixels in {centroids}"
        raise SceneError(meta.path, expected, f"{table.shape[1]} x {table.shape[0]}", AGAIN)
    table = values[table[..., :3].reshape(-1, bands, 3)]
    found = pixels(labels).astype(np.int64)
    index = found[:, 0] + 256 * found[:, 1]
    if index.size and index.max() >= entries:
        raise SceneError(meta.path, f"labels below {entries} in {labels}", f"{index.max()}", AGAIN)
    return table[index]


def write_sog(
    path: Path,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    order: Int[np.ndarray, "N"] | None = None,
) -> None:
    """Write a .sog of version 2, atomically. Gaussians come in spatial order, which compresses better,
    unless another is given.

    Scales and colours are rounded to codebooks of 256 values. More than 65,536 Gaussians share that many
    sets of view-dependent colour.

    Args:
        path: the file.
        gaussians: Gaussians that can all be drawn.
        antialiased: whether the scene was fitted with antialiasing.
        order: rows of the Gaussians in the order of the file.
    """
    columns = columns_of(gaussians)
    order = spatial_order(columns.means) if order is None else order
    columns = Columns(*(value[order] for value in columns))
    logs = np.sign(columns.means) * np.log1p(np.abs(columns.means))
    mins, maxs = logs.min(axis=0), logs.max(axis=0)
    steps = np.round((logs - mins) / np.where(maxs > mins, maxs - mins, 1) * 65535).astype(np.uint16)
    scales, sh0 = codebook(columns.log_scales), codebook((columns.colors - 0.5) / SH_C0)
    opacities = to_bytes(columns.opacities)[:, None]
    pictures = {
        "means_l.webp": _square(steps & 255),
        "means_u.webp": _square(steps >> 8),
        "scales.webp": _square(nearest(scales, columns.log_scales)),
        "quats.webp": _square(_quat_pixels(columns.quats)),
        "sh0.webp": _square(np.hstack([nearest(sh0, (columns.colors - 0.5) / SH_C0), opacities])),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "gsjax"},
        "count": gaussians.num,
        "antialias": antialiased,
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": sh0.tolist(), "files": ["sh0.webp"]},
    }
    if columns.rest.shape[1]:
        meta["shN"], more = _rest_pictures(columns.rest)
        pictures |= more
    with atomic_write(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, pixels in pictures.items():
            archive.writestr(name, _webp(pixels))
        archive.writestr(_META, json.dumps(meta))


def _quat_pixels(quats: np.ndarray) -> np.ndarray:
    """Bytes of unit quaternions w x y z, [N,4]."""
    largest = np.argmax(np.abs(quats), axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1, 1)
    others = quats[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return np.hstack([to_bytes(others * np.sqrt(0.5) + 0.5), (_LARGEST + largest[:, None]).astype(np.uint8)])


def _rest_pictures(rest: np.ndarray) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The entry of meta.json and the pictures of view-dependent colour, [N,K-1,3]."""
    bands = rest.shape[1]
    entries, labels = palette(rest.reshape(len(rest), -1), _MOST_PALETTE)
    values = codebook(entries)
    rows = -(-len(entries) // _PALETTE_ROW)
    table = np.zeros((rows * _PALETTE_ROW, bands, 3), np.uint8)
    table[: len(entries)] = nearest(values, entries).reshape(-1, bands, 3)
    table = table.reshape(rows, _PALETTE_ROW * bands, 3)
    pair = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    meta = {
        "count": len(entries),
        "bands": REST_SIZES.index(bands),
        "codebook": values.tolist(),
        "files": files,
    }
    return meta, dict(zip(files, (_opaque(table), _square(pair)), strict=True))


def _square(rows: np.ndarray) -> UInt8[np.ndarray, "H W 4"]:
    """Values of Gaussians, [N,3] or [N,4], as the pixels of a nearly square picture."""
    width = 4 * int(np.ceil(np.sqrt(len(rows)) / 4))
    height = -(-len(rows) // width)
    pixels = np.zeros((width * height, rows.shape[1]), np.uint8)
    pixels[: len(rows)] = rows
    pixels = pixels.reshape(height, width, -1)
    return pixels if rows.shape[1] == 4 else _opaque(pixels)


def _opaque(pixels: np.ndarray) -> UInt8[np.ndarray, "H W 4"]:
    return np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)


def _webp(pixels: UInt8[np.ndarray, "H W 4"]) -> bytes:
    """A picture as lossless WebP, which keeps the colour of transparent pixels too."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, quality=75, method=2, exact=True)
    return stream.getvalue()
