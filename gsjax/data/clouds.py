"""Coloured points in PLY files."""

import warnings
from pathlib import Path

import numpy as np

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.photographs import Cloud

_GREY = 0.5  # for points without a colour


def read_cloud(path: Path) -> Cloud:
    """The points of a PLY file, grey if it has no colours. Points that are not finite are left out, with a
    DataWarning.

    Raises:
        DataError: the file is missing, truncated, or not a PLY file with x, y and z.
    """
    from plyfile import PlyData, PlyParseError

    try:
        vertices = PlyData.read(str(path))["vertex"]
        points = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
        names = {prop.name for prop in vertices.properties}
        colors = np.full(points.shape, _GREY)
        if {"red", "green", "blue"} <= names:
            colors = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=-1)
            colors = colors / (255 if np.issubdtype(colors.dtype, np.integer) else 1)
    except (FileNotFoundError, IsADirectoryError):
        advice = "Restore it, or remove the reference to it."
        raise DataError(path, "a point cloud", "no such file", advice) from None
    except (PlyParseError, KeyError, ValueError, TypeError, EOFError, OverflowError, MemoryError) as error:
        raise DataError(
            path, "a PLY file with x, y, z", f"something else ({error})", "Fetch it again."
        ) from None
    finite = np.isfinite(points).all(-1) & np.isfinite(colors).all(-1)
    if not finite.all():
        some = f"{(~finite).sum()} of {len(finite)} points"
        warnings.warn(f"{path}: {some} are not finite and are left out", DataWarning, stacklevel=2)
    return Cloud(points[finite], np.clip(colors[finite], 0, 1))
