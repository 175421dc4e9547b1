"""The .splat of antimatter15: 32 bytes per Gaussian and no header.

    x y z              float32
    scales             3 float32, not logarithms
    red green blue     uint8, 0 to 1, of the constant harmonic only; then the opacity
    w x y z            uint8, (k - 128) / 128 of a unit quaternion

Axes are those of the 3DGS PLY. Source: convert.py and main.js in github.com/antimatter15/splat.
"""

from pathlib import Path

import numpy as np

from gsjax.io.atomic import atomic_write
from gsjax.io.scene_file import Columns, SceneError, SceneReport, columns_of, drawable, gaussians_of, to_bytes
from gsjax.scene.gaussians import Gaussians

RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
_ADVICE = "It may be cut off or of another format; .splat has no header by which to tell"
_SANE = 1e9


def read_splat(path: Path) -> tuple[Gaussians, SceneReport]:
    """The Gaussians of a .splat, of degree 0, and the report.

    Args:
        path: the file.

    Raises:
        SceneError: its size is no multiple of 32 bytes, or most of it makes no sense as Gaussians.
    """
    data = path.read_bytes()
    if len(data) % RECORD.itemsize:
        found = f"{len(data)} bytes"
        raise SceneError(path, f"a multiple of {RECORD.itemsize} bytes, those of a Gaussian", found, _ADVICE)
    records = np.frombuffer(data, RECORD)
    with np.errstate(invalid="ignore"):  # of signalling NaN
        scales, means = (records[name].astype(np.float64) for name in ("scales", "means"))
        sane = (np.abs(means) < _SANE).all(1) & (scales >= 0).all(1) & (scales < _SANE).all(1)
    if 2 * sane.sum() < len(records):
        found = f"{len(records) - sane.sum()} of {len(records)} with other values"
        raise SceneError(path, "finite positions and scales", found, _ADVICE)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(np.maximum(scales, 1e-12))
    colors = records["rgba"] / 255
    quats = records["quats"].astype(np.float64) - 128
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    quats /= np.where(length > 0, length, 1)
    none = np.zeros((len(records), 0, 3))
    columns = Columns(means, quats, log_scales, colors[:, 3], colors[:, :3], none)
    return drawable(path, ".splat", gaussians_of(columns))


def splat_bytes(gaussians: Gaussians) -> bytes:
    """The records of Gaussians that can all be drawn."""
    columns = columns_of(gaussians)
    records = np.empty(gaussians.num, RECORD)
    records["means"], records["scales"] = columns.means, np.exp(columns.log_scales)
    records["rgba"][:, :3] = to_bytes(columns.colors)
    records["rgba"][:, 3] = to_bytes(columns.opacities)
    records["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return records.tobytes()


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """Write a .splat, atomically.

    Args:
        path: the file.
        gaussians: Gaussians that can all be drawn.
    """
    with atomic_write(path) as temporary:
        temporary.write_bytes(splat_bytes(gaussians))
