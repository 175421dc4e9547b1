"""The keys of a transforms.json: those that are read, and warnings about those that are not."""

import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsjax.data.errors import DataWarning
from gsjax.io.brief import shortened

SPLITS = ("train", "val", "test")
DEPTH_UNIT_M = 0.001  # nerfstudio's default
DEPTHS = ("depth_file_path", "depth_path")
UNITS = ("integer_depth_scale", "depth_unit_scale_factor")
# instant-ngp selects the camera model by keys of its own.
MODEL_KEYS = {"is_fisheye": "OPENCV_FISHEYE", "latlong": "LATLONG", "ftheta_p0": "FTHETA"}

_READ = {
    *(
        "frames",
        "ply_file_path",
        "file_path",
        "transform_matrix",
        "mask_path",
        "time",
        "enable_depth_loading",
    ),
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "camera_model"),
    *("k1", "k2", "k3", "k4", "p1", "p2"),
    *(f"{split}_filenames" for split in SPLITS),
    *(*DEPTHS, *UNITS, *MODEL_KEYS),
}
_WITHOUT_EFFECT = {"applied_transform", "applied_scale", "aabb_scale", "scale", "offset", "rotation"}
_LISTED = 8  # keys
_DATA = re.compile(
    r"depth|mask|normal|semantic|segment|label|flow|time|unit|scale|distort|lens|fisheye|skew|shutter|split|path|"
    r"points|cloud|intrinsic|^[kps]\d$|^f_?[xy]$|^(width|height)$",
    re.IGNORECASE,
)


def warn_of_unread(root: Path, file: Path, meta: Mapping[str, Any]) -> None:
    """Warns with DataWarning about keys that are not read but look like data, by their names or because
    their values name files.

    Args:
        root: the folder to which such names are relative.
        file: the file, for the message.
        meta: its contents.
    """
    counts: dict[str, int] = {}
    for number, values in enumerate((meta, *meta["frames"])):
        for key, value in values.items() if isinstance(values, dict) else ():
            if key in _READ or key in _WITHOUT_EFFECT or value is None:
                continue
            if _DATA.search(key) or (isinstance(value, str) and os.path.isfile(root / value)):
                counts[key] = counts.get(key, 0) + (number > 0)
    if counts:
        found = shortened((f"{key} (of {n} frames)" if n else key for key, n in counts.items()), _LISTED)
        advice = "give them names that are (docs/data.md), or leave them out"
        warnings.warn(f"{file}: these keys are not read: {found}; {advice}", DataWarning, stacklevel=3)


def warn_of_unknown_unit(file: Path, meta: Mapping[str, Any]) -> None:
    """Warns with DataWarning if instant-ngp's depth comes without its unit, which has no default there."""
    frames = [frame for frame in meta["frames"] if isinstance(frame, dict)]
    if any("depth_path" in frame for frame in frames) and not any(
        name in place for name in UNITS for place in (meta, *frames)
    ):
        assumed = f"depth_path without integer_depth_scale: assuming {DEPTH_UNIT_M:g} a step"
        advice = "add it, or give depth_unit_m (--read.depth-unit-m)"
        warnings.warn(f"{file}: {assumed}; {advice}", DataWarning, stacklevel=3)
