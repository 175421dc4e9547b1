"""Exports of the app Record3D ("EXR + RGB sequence"): one moving phone with depth and ARKit's poses.

rgb/NUMBER.jpg          or .png, from 0
depth/NUMBER.exr        metres in floats, registered to colour, at lower resolution (256x192 from LiDAR)
metadata.json           or metadata: w, h, fps; K, 9 numbers in column-major order, for w x h pixels;
                        poses, a row [qx qy qz qw tx ty tz] per frame, camera to world, OpenGL axes, metres;
                        in newer versions perFrameIntrinsicCoeffs, [fx fy cx cy] per frame, and
                        frameTimestamps, seconds. initPose, which rotates the world, is not needed.

The app's author describes them in github.com/marek-simonik/record3d, issues 27, 33, 36, 67, 83 and 108.
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax import extras
from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.exr import read_exr_depth
from gsjax.data.files import image_size, read_image, read_json
from gsjax.data.frame_folders import DEFAULT_RATE_HZ, numbered
from gsjax.data.lens import intrinsics_matrix, scaled_intrinsics
from gsjax.data.names import find_file
from gsjax.data.origin import near_origin
from gsjax.data.resizing import nearest_resized
from gsjax.data.sequence import Sequence
from gsjax.data.validation import check_quaternions
from gsjax.geometry.cameras import viewmat_from_opengl
from gsjax.io.brief import shortened

EXPORT_THIS = 'In Record3D choose Export, "EXR + RGB sequence", and give that folder.'
_FOLDER = "EXR_RGBD"
_SAME_SHAPE = 0.05  # on the aspect ratio: that of a small depth map is rounded


def is_record3d(root: Path) -> bool:
    """Whether a folder, or one inside it, has this layout."""
    return bool(_exports(root)) or _is_unpacked(root)


def _exports(root: Path) -> list[Path]:
    """The folders that hold rgb and depth: this one, or else those inside it."""
    found = {file.parents[1] for file in root.glob("depth/*.exr")}
    found = found or {file.parents[1] for file in root.glob("*/depth/*.exr")}
    found = found or {file.parents[1] for file in root.glob(f"*/{_FOLDER}/depth/*.exr")}
    return sorted(folder for folder in found if (folder / "rgb").is_dir())


def _is_unpacked(root: Path) -> bool:
    """Whether a folder is an unpacked .r3d file."""
    return (root / "metadata").is_file() and next(root.glob("rgbd/*.depth"), None) is not None


@near_origin
def read_record3d(path: str | Path) -> Sequence:
    """The frames of an export that have colour, depth and a pose: one camera, 0.

    The others are left out, with a DataWarning that counts them. Depth is resampled to the pictures' size:
    each pixel takes the value of the depth pixel that its centre lies in. If the pictures are downscaled
    copies, intrinsics are scaled with them. Without times in the metadata, frames follow at its rate or,
    without one, at 30 Hz.

    Args:
        path: the folder with rgb and depth, or the one that it lies in.

    Raises:
        DataError: there are several exports or an unpacked .r3d file, metadata are missing or malformed, or
            no frame is complete.
        MissingExtra: the package OpenEXR is not installed.
    """
    root = Path(path)
    folder = _single_export(root)
    extras.load("OpenEXR", "record3d", "a recording by Record3D")
    images, depths = numbered(folder / "rgb"), numbered(folder / "depth", (".exr",))
    meta = _Metadata(_metadata_of(folder))
    numbers = _usable(folder, meta, images, depths)
    width, height = image_size(images[numbers[0]])
    size, first = (width, height), images[numbers[0]]
    files = {"image": images, "depth": depths}
    quats, places = meta.poses[numbers, :4], meta.poses[numbers, 4:]
    to_world = np.tile(np.eye(4), (len(numbers), 1, 1))
    to_world[:, :3, :3], to_world[:, :3, 3] = Rotation.from_quat(quats).as_matrix(), places

    def load_depth(t: int, c: int) -> Float[np.ndarray, "height width"]:
        return _read_depth(depths[numbers[t]], size)

    return Sequence(
        name=(folder.resolve().parent if folder.name == _FOLDER else folder.resolve()).name,
        camera_ids=(0,),
        width=width,
        height=height,
        times=meta.times[numbers],
        frame_ids=tuple(numbers),
        Ks=np.stack([scaled_intrinsics(K, meta.size, size, first) for K in meta.Ks[numbers]])[:, None],
        viewmats=viewmat_from_opengl(to_world)[:, None],
        load_image=lambda t, c: read_image(images[numbers[t]], width, height),
        load_depth=nearest_resized(load_depth, lambda t, c: size),
        locate=lambda kind, t, c: str(files[kind][numbers[t]]),
    )


def _single_export(root: Path) -> Path:
    exports = _exports(root)
    if len(exports) == 1:
        return exports[0]
    if exports:
        found = f"{len(exports)} ({shortened(str(export.relative_to(root)) for export in exports)})"
        raise DataError(root, "one recording by Record3D", found, f"Give one of them, such as {exports[0]}.")
    found = "an unpacked .r3d file, whose depth is not read" if _is_unpacked(root) else "none"
    raise DataError(root, "rgb and depth/NUMBER.exr as Record3D exports them", found, EXPORT_THIS)


def _metadata_of(folder: Path) -> Path:
    for place in (folder, folder.parent) if folder.name == _FOLDER else (folder,):
        if (file := find_file(place, "metadata", (".json",))) is not None:
            return file
    advice = f"Copy it from the export: it has the poses. {COMPLETE}"
    raise DataError(folder / "metadata.json", "Record3D's metadata", "no such file", advice)


class _Metadata:
    """Poses, intrinsics and times, one row per frame; NaN where a frame has none.

    Attributes:
        path: the file.
        size: width and height that the intrinsics are for, pixels.
        poses: quaternions x y z w and positions, [frames, 7].
        Ks: intrinsics, [frames, 3, 3].
        times: seconds, [frames].
    """

    def __init__(self, path: Path):
        self.path, self.values = path, read_json(path)
        if not isinstance(self.values, dict):
            found = f"a {type(self.values).__name__}"
            raise DataError(path, "one JSON object", found, "Export the recording again.")
        self.poses = self._rows("poses", 7)
        self.size = (self._number("w"), self._number("h"))
        frames = len(self.poses)
        if self.values.get("perFrameIntrinsicCoeffs"):
            coefficients = _padded(self._rows("perFrameIntrinsicCoeffs", 4), frames)
            self.Ks = np.stack([intrinsics_matrix(row) for row in coefficients])
        else:
            K = self._rows("K", 9).reshape(-1, 3, 3)[0].T
            self.Ks = np.tile(K, (frames, 1, 1))
        if self.values.get("frameTimestamps"):
            self.times = _padded(self._rows("frameTimestamps", 1), frames)[:, 0]
        else:
            self.times = np.arange(frames) / self._number("fps", DEFAULT_RATE_HZ)

    def _rows(self, key: str, columns: int) -> Float[np.ndarray, "rows columns"]:
        """The numbers of a key, in rows; null becomes NaN."""
        expected = f"{key}, {columns} numbers" + (" a frame" if key != "K" else "")
        if key not in self.values:
            raise DataError(self.path, expected, f"no {key}", "Export the recording again.")
        try:
            rows = np.array(self.values[key], np.float64)
        except (ValueError, TypeError, OverflowError):
            raise self._malformed(key, expected) from None
        if not rows.size or (rows.shape[-1:] != (columns,) and (columns != 1 or rows.ndim != 1)):
            raise self._malformed(key, expected)
        return rows.reshape(-1, columns)

    def _number(self, key: str, default: float | None = None) -> float:
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
            raise self._malformed(key, f"{key}, a number above 0")
        return value

    def _malformed(self, key: str, expected: str) -> DataError:
        found: Any = self.values.get(key)
        text = repr(found)[:80] if key in self.values else f"no {key}"
        return DataError(self.path, expected, text, "Correct it, or export the recording again.")


def _padded(rows: Float[np.ndarray, "n k"], frames: int) -> Float[np.ndarray, "frames k"]:
    """The rows, truncated or padded with NaN to the number of frames."""
    padded = np.full((frames, rows.shape[1]), np.nan)
    padded[: len(rows)] = rows[:frames]
    return padded


def _usable(folder: Path, meta: _Metadata, images: dict[int, Path], depths: dict[int, Path]) -> list[int]:
    """Numbers of the complete frames, in order; a DataWarning counts the others."""
    lengths = np.linalg.norm(meta.poses[:, :4], axis=1)
    posed = set(np.flatnonzero(np.isfinite(meta.poses).all(axis=1) & (lengths > 0)).tolist())
    measured = set(np.flatnonzero(np.isfinite(meta.Ks).all(axis=(1, 2))).tolist())
    kept: list[int] = []
    left: dict[str, list[int]] = {}
    for number in sorted(images.keys() | depths.keys() | set(range(len(meta.poses)))):
        if number not in images:
            reason = "without a picture"
        elif number not in depths:
            reason = "without depth"
        elif number not in posed:
            reason = "without a pose"
        elif number not in measured:
            reason = "without intrinsics"
        elif not (meta.times[kept[-1]] if kept else -np.inf) < meta.times[number] < np.inf:
            reason = "without a later time"
        else:
            kept.append(number)
            continue
        left.setdefault(reason, []).append(number)
    count = sum(map(len, left.values()))
    told = ", ".join(f"{len(of)} {reason} ({shortened(map(str, of))})" for reason, of in left.items())
    if not kept:
        advice = f"{COMPLETE} The app records poses with LiDAR, not with the front camera."
        raise DataError(folder, "a frame with colour, depth and pose", f"none of {count}: {told}", advice)
    if left:
        message = f"{folder}: {count} of {count + len(kept)} frames are left out: {told}"
        warnings.warn(message, DataWarning, stacklevel=3)
    check_quaternions(
        meta.poses[kept, :4],
        lambda i: f"{meta.path}, frame {kept[i]}",
        "Correct it, or remove that frame's picture.",
    )
    return kept


def _read_depth(path: Path, size: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    """The stored depth, after a check that its aspect ratio is that of the pictures."""
    depth = read_exr_depth(path)
    rows, columns = depth.shape
    if abs(columns * size[1] / (rows * size[0]) - 1) > _SAME_SHAPE:
        expected = f"depth of the shape of pictures of {size[0]}x{size[1]} pixels"
        advice = "Depth and pictures must not be cropped or turned after the export."
        raise DataError(path, expected, f"{columns}x{rows}", advice)
    return depth
