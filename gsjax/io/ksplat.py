"""Reads mkkellogg's .ksplat (GaussianSplats3D): sections of records, little-endian. It is not written.

    header     4096 bytes: version, numbers of sections and of Gaussians, level, range of harmonics
    sections   1024 bytes each: numbers of Gaussians, of buckets and of their bytes, degree of harmonics
    data       of each section: lengths of partly filled buckets, centres of buckets, records

A record holds the centre, scales, rotation w x y z, red green blue opacity as uint8, and harmonics, band by
band and channel by channel within each band. Level 0 stores float32. Levels 1 and 2 store float16, except
that centres are uint16 offsets from the centre of the Gaussian's bucket, and harmonics of level 2 are uint8
fractions of a range. Axes are those of the 3DGS PLY. Source: SplatBuffer.js in
github.com/mkkellogg/GaussianSplats3D.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.io.scene_file import (
    AGAIN,
    REST_SIZES,
    Columns,
    SceneError,
    SceneReport,
    drawable,
    gaussians_of,
)
from gsjax.scene.gaussians import Gaussians

MAGIC = b"\x00\x01\x00\x00"
"""Version 0.1, the only one."""
_HEADER_SIZE, _SECTION_SIZE = 4096, 1024
_HEADER = struct.Struct("<4xI12xH14xff")
"""Number of sections, level, and range of harmonics."""
_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
"""The fields of a `_Section` except its start."""
_RANGE = 32767
_CENTER = np.dtype(("<f4", 3))
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Types of centres, of scales and rotations, and of harmonics, by level."""


class _Section(NamedTuple):
    """The header of a section, and where its data start in the file."""

    count: int
    room: int
    bucket_size: int
    buckets: int
    block: float
    bucket_bytes: int
    steps: int
    full: int
    partial: int
    degree: int
    start: int

    @property
    def buckets_start(self) -> int:
        return self.start + 4 * self.partial

    @property
    def records_start(self) -> int:
        return self.buckets_start + self.bucket_bytes * self.buckets


def read_ksplat(path: Path) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of a .ksplat, and the report.

    Args:
        path: the file.

    Raises:
        SceneError: it is not a .ksplat, is cut off, or its counts are inconsistent.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_SIZE or data[:4] != MAGIC:
        raise SceneError(path, "a .ksplat of version 0.1", f"{data[:4]!r} in {len(data)} bytes", AGAIN)
    num_sections, level, low, high = _HEADER.unpack_from(data)
    if level >= len(_TYPES):
        raise SceneError(path, "compression level 0, 1 or 2", f"{level}", AGAIN)
    start, parts = _HEADER_SIZE + num_sections * _SECTION_SIZE, []
    if start > len(data):
        raise SceneError(path, f"{num_sections} sections", f"only {len(data)} bytes", AGAIN)
    for number in range(num_sections):
        section = _Section(*_SECTION.unpack_from(data, _HEADER_SIZE + number * _SECTION_SIZE), start)
        if section.degree >= len(REST_SIZES):
            advice = "Export the scene with spherical harmonics of degree 3 or less"
            raise SceneError(path, "spherical harmonics of degree 0 to 3", f"degree {section.degree}", advice)
        record = _record(level, section.degree)
        end = section.records_start + record.itemsize * section.room
        if end > len(data) or section.count > section.room:
            found = f"{section.count} Gaussians in room for {section.room}, {len(data)} bytes of {end}"
            raise SceneError(path, f"section {number} with all its data", found, AGAIN)
        if section.count:
            with np.errstate(invalid="ignore"):  # NaN, whose Gaussians are left out later
                parts.append(_decode(path, data, section, record, (low or -1.5, high or 1.5)))
        start = end
    rest = max((part.rest.shape[1] for part in parts), default=0)
    padded = [
        part._replace(rest=np.pad(part.rest, ((0, 0), (0, rest - part.rest.shape[1]), (0, 0))))
        for part in parts
    ]
    if not padded:
        raise SceneError(path, "Gaussians", "none", AGAIN)
    columns = Columns(*map(np.concatenate, zip(*padded, strict=True)))
    return drawable(path, f".ksplat of level {level}", gaussians_of(columns))


def _record(level: int, degree: int) -> np.dtype:
    """The dtype of a record."""
    center, shape, harmonics = _TYPES[level]
    fields = [("means", center, 3), ("scales", shape, 3), ("quats", shape, 4), ("rgba", "u1", 4)]
    return np.dtype([*fields, ("rest", harmonics, (3 * REST_SIZES[degree],))])


def _decode(
    path: Path, data: bytes, section: _Section, record: np.dtype, limits: tuple[float, float]
) -> Columns:
    """The values of a section."""
    records = np.frombuffer(data, record, section.count, section.records_start)
    means = records["means"].astype(np.float64)
    if record["means"].base.kind == "u":
        centers = _bucket_centers(path, data, section)
        steps = section.steps or _RANGE
        means = (means - steps) * (section.block / 2 / steps) + centers
    rest = records["rest"].astype(np.float64)
    if record["rest"].base == np.uint8:
        low, high = limits
        rest = low + rest / 255 * (high - low)
    count, bands = section.count, range(1, section.degree + 1)
    # band by band, and in each [3 channels, 2 degree + 1 coefficients]
    parts = [
        rest[:, 3 * (band**2 - 1) : 3 * ((band + 1) ** 2 - 1)].reshape(count, 3, -1).transpose(0, 2, 1)
        for band in bands
    ]
    rest = np.concatenate(parts, axis=1) if parts else np.zeros((count, 0, 3))
    quats = records["quats"].astype(np.float64)
    log_scales = np.log(np.maximum(records["scales"].astype(np.float64), 1e-12))
    colors = records["rgba"] / 255
    return Columns(means, quats, log_scales, colors[:, 3], colors[:, :3], rest)


def _bucket_centers(path: Path, data: bytes, section: _Section) -> np.ndarray:
    """The centre of the bucket of each Gaussian of a section, [N,3]."""
    lengths = np.frombuffer(data, "<u4", section.partial, section.start).astype(np.int64)
    total = section.full * section.bucket_size + int(lengths.sum())
    if (
        section.bucket_bytes < _CENTER.itemsize
        or section.full + section.partial > section.buckets
        or total < section.count
    ):
        found = f"{section.buckets} buckets of {section.bucket_bytes} bytes for {total}"
        raise SceneError(path, f"buckets of all {section.count} Gaussians", found, AGAIN)
    rows = np.arange(section.count)
    inside = section.full * section.bucket_size
    ends = inside + np.cumsum(lengths)
    bucket = np.where(
        rows < inside,
        rows // max(section.bucket_size, 1),
        section.full + np.searchsorted(ends, rows, side="right"),
    )
    layout = np.dtype({"names": ["center"], "formats": [_CENTER], "itemsize": section.bucket_bytes})
    table = np.frombuffer(data, layout, section.buckets, section.buckets_start)
    return table["center"].astype(np.float64)[bucket]
