"""The TUM RGB-D benchmark (Sturm et al. 2012): one moving camera with depth and poses from motion capture.

rgb.txt            lines "stamp rgb/STAMP.png", seconds; # starts a comment, in all three files
depth.txt          lines "stamp depth/STAMP.png": 16 bits, 5000 steps per metre, 0 = invalid; registered to
                   the colour image pixel by pixel
groundtruth.txt    lines "stamp tx ty tz qx qy qz qw": camera to world, OpenCV axes, at its own rate
"""

import re
import warnings
from collections.abc import Sequence as Numbers
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from gsjax.data.association import associate
from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import image_size, read_depth, read_image, read_text
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.names import find_file
from gsjax.data.origin import near_origin
from gsjax.data.sequence import Sequence
from gsjax.data.text import fields
from gsjax.data.validation import check_quaternions
from gsjax.geometry.distortion import undistort_map

MAX_SKEW_S = 0.02
"""The benchmark's own limit on the time between colour, depth and pose of a frame."""

DEPTH_UNIT_M = 1 / 5000
"""Metres per depth step in the benchmark's files."""


class _Calibration(NamedTuple):
    """Intrinsics as published with the benchmark: fx, fy, cx, cy with pixel centres at integers."""

    pinhole: tuple[float, float, float, float]
    distortion: tuple[float, ...]  # OpenCV's k1, k2, p1, p2, k3


_CALIBRATIONS = {
    1: _Calibration((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    2: _Calibration((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    3: _Calibration((535.4, 539.2, 320.1, 247.6), ()),  # its images are published undistorted
}
_SIZE = (640, 480)
_INTRINSICS = "the camera's intrinsics as K (--read.K): fx fy cx cy in pixels, with pixel centres at +0.5."


@near_origin
def read_tum(
    path: str | Path,
    K: Float[np.ndarray, "3 3"] | tuple[float, float, float, float] | None = None,
    distortion: Numbers[float] = (),
    *,
    max_skew: float = MAX_SKEW_S,
    depth_unit_m: float | None = None,
) -> Sequence:
    """The sequence in a folder of this layout: one camera, 0, whose frames are the colour images.

    Colour, depth and poses are not synchronised: each colour image is paired with the depth image nearest in
    time and with a pose interpolated between the measurements before and after it (linear in position,
    spherical in rotation), since at 1 rad/s the nearest of 100 Hz poses would be 2 to 3 pixels off. Frames
    farther than `max_skew` from any depth image or measured pose are left out, as are those whose files are
    missing, lines that repeat a stamp, and poses that are not finite: each with a DataWarning that counts
    them. Lines may be in any order. Times are the stamps; `frame_ids` count the stamps of rgb.txt from 0.

    If the lens has distortion (freiburg1 and 2), colour and depth are resampled to a pinhole camera of the
    same K; pixels outside the photograph are black and have no depth.

    Args:
        path: the folder.
        K: intrinsics of one's own camera, or (fx, fy, cx, cy), with pixel centres at +0.5; default: those
            published for freiburg1, 2 or 3, chosen by the folder's name.
        distortion: OpenCV distortion coefficients that belong to a given K: none, 4, 5 or 8.
        max_skew: largest time between colour, depth and pose, seconds.
        depth_unit_m: metres per depth step; default: 1/5000, as in the benchmark, with a warning for a camera
            of one's own.

    Raises:
        DataError: a file is missing or has malformed lines, the folder's name does not identify the camera,
            or no frame has colour, depth and pose.
    """
    root = Path(path)
    colors, depths = _FileList.read(root, "rgb.txt"), _FileList.read(root, "depth.txt")
    stamps, poses = _read_poses(root / "groundtruth.txt")
    clocks = {"colour": colors.stamps, "depth": depths.stamps, "pose": stamps}
    matched = associate(root, clocks, max_skew)
    images = [colors.paths[i] for i in matched[:, 0]]
    depth_images = [depths.paths[i] for i in matched[:, 1]]
    times = colors.stamps[matched[:, 0]]
    width, height = image_size(images[0])
    if K is None:
        K, distortion = _published(root, images[0], (width, height))
    elif depth_unit_m is None:
        warnings.warn(
            f"{root}: depth is read in the benchmark's unit, 5000 steps a metre, as none is given for this "
            "camera; if it measures millimetres, set depth_unit_m (--read.depth-unit-m) to 0.001",
            DataWarning,
            stacklevel=2,
        )
    depth_unit_m = DEPTH_UNIT_M if depth_unit_m is None else depth_unit_m
    K = intrinsics_matrix(K)
    lens = _Lens(K, distortion, width, height)
    frames = len(times)
    files = {"image": images, "depth": depth_images}
    return Sequence(
        name=root.resolve().name,
        camera_ids=(0,),
        width=width,
        height=height,
        times=times,
        frame_ids=tuple(colors.numbers[matched[:, 0]].tolist()),
        Ks=np.broadcast_to(K, (frames, 1, 3, 3)),
        viewmats=np.linalg.inv(_poses_at(times, stamps, poses))[:, None],
        load_image=lambda t, c: lens.undistort(read_image(images[t], width, height)),
        load_depth=lambda t, c: lens.undistort(read_depth(depth_images[t], depth_unit_m, width, height)),
        locate=lambda kind, t, c: str(files[kind][t]),
    )


class _FileList(NamedTuple):
    """The files named in a list, sorted by time, with their positions in it."""

    numbers: Int[np.ndarray, "n"]
    stamps: Float[np.ndarray, "n"]
    paths: list[Path]

    @classmethod
    def read(cls, root: Path, name: str) -> "_FileList":
        """Read a list, leaving out files that do not exist, with a warning that counts them."""
        stamps, rows = _read_lines(root / name, "stamp file", columns=2)
        files = [find_file(root, row[0]) for row in rows]
        exists = np.array([file is not None for file in files])
        if not exists.any():
            found = f"none of {len(rows)}, for example no {rows[0][0]}"
            raise DataError(root / name, "files that exist", found, COMPLETE)
        if not exists.all():
            message = f"{root / name}: {np.sum(~exists)} of {len(rows)} files do not exist and are left out"
            warnings.warn(message, DataWarning, stacklevel=4)
        numbers = np.flatnonzero(exists)
        return cls(numbers, stamps[exists], [file for file in files if file is not None])


def _read_lines(path: Path, form: str, columns: int) -> tuple[Float[np.ndarray, "n"], list[list[str]]]:
    """Stamps in increasing order, and the fields after each; lines that repeat a stamp are left out, with a
    warning that counts them."""
    stamps, rows = [], []
    for number, line in enumerate(read_text(path, f"lines '{form}'").split("\n"), start=1):
        row = fields(line.partition("#")[0])
        if not row:
            continue
        if len(row) != columns or not _is_finite(row[0]):
            expected, found = f"'{form}' in line {number}", repr(line[:80])
            raise DataError(path, expected, found, "Correct the line, or comment it out with #.")
        stamps.append(float(row[0]))
        rows.append(row[1:])
    if not rows:
        raise DataError(path, f"lines '{form}'", "none", "Fetch the file again.")
    stamps, first = np.unique(stamps, return_index=True)
    if len(first) < len(rows):
        message = f"{path}: {len(rows) - len(first)} of {len(rows)} lines repeat a stamp and are left out"
        warnings.warn(message, DataWarning, stacklevel=5)
    return stamps, [rows[i] for i in first]


def _is_finite(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False


def _read_poses(path: Path) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 7"]]:
    """Stamps, and positions with quaternions x y z w; poses that are not finite are left out, with a warning
    that counts them."""
    stamps, rows = _read_lines(path, "stamp tx ty tz qx qy qz qw", columns=8)
    try:
        poses = np.array(rows, np.float64)
    except ValueError as error:
        advice = "Correct the line, or comment it out with #."
        raise DataError(path, "numbers only", str(error), advice) from None
    known = np.isfinite(poses).all(axis=1)
    if not known.any():
        raise DataError(path, "finite poses", "none", "Fetch the file again.")
    if not known.all():
        message = f"{path}: {np.sum(~known)} of {len(known)} poses are not finite and are left out"
        warnings.warn(message, DataWarning, stacklevel=3)
    stamps, poses = stamps[known], poses[known]
    check_quaternions(
        poses[:, 3:],
        lambda i: f"{path}, at {stamps[i]:.6f} s",
        "Correct that line, or comment it out with #.",
    )
    return stamps, poses


def _poses_at(
    times: Float[np.ndarray, "t"], stamps: Float[np.ndarray, "n"], poses: Float[np.ndarray, "n 7"]
) -> Float[np.ndarray, "t 4 4"]:
    """Camera-to-world transforms interpolated between the measured ones; constant before the first and after
    the last."""
    inside = np.clip(times, stamps[0], stamps[-1])
    measured = Rotation.from_quat(poses[:, 3:])
    transforms = np.tile(np.eye(4), (len(times), 1, 1))
    rotations = Slerp(stamps, measured)(inside) if len(stamps) > 1 else measured[np.zeros(len(times), int)]
    transforms[:, :3, :3] = rotations.as_matrix()
    transforms[:, :3, 3] = np.stack([np.interp(inside, stamps, axis) for axis in poses[:, :3].T], axis=1)
    return transforms


def _published(
    root: Path, image: Path, size: tuple[int, int]
) -> tuple[Float[np.ndarray, "3 3"], tuple[float, ...]]:
    """K, centres at +0.5, and distortion of the camera that the folder's name identifies."""
    name = root.resolve().name
    camera = re.search(r"(?:freiburg|fr)([123])(?!\d)", name.lower())
    if camera is None:
        expected = "a folder name with freiburg1, freiburg2 or freiburg3, which identifies the camera"
        advice = f"Give {_INTRINSICS} Folders of the benchmark have the camera in their names"
        raise DataError(root, expected, repr(name), advice)
    if size != _SIZE:
        expected = f"{_SIZE[0]}x{_SIZE[1]} pixels, for which freiburg{camera[1]} is calibrated"
        found = f"{size[0]}x{size[1]}"
        raise DataError(image, expected, found, f"Give {_INTRINSICS}")
    (fx, fy, cx, cy), distortion = _CALIBRATIONS[int(camera[1])]
    return np.array([[fx, 0, cx + 0.5], [0, fy, cy + 0.5], [0, 0, 1]]), distortion


class _Lens:
    """Resamples distorted pictures to a pinhole camera of the same K."""

    def __init__(self, K: Float[np.ndarray, "3 3"], distortion: Numbers[float], width: int, height: int):
        self.map = None
        if any(distortion):
            where = undistort_map(jnp.asarray(K, float), jnp.asarray(distortion, float), width, height)
            self.map = np.asarray(where, np.float32) - 0.5  # OpenCV's centres
            self.outside = ((self.map < -0.5) | (self.map >= np.array([width, height]) - 0.5)).any(axis=-1)

    def undistort(self, picture: np.ndarray) -> np.ndarray:
        """Colour is interpolated; depth takes the nearest pixel: a mean of two surfaces lies on neither."""
        if self.map is None:
            return picture
        interpolation = cv2.INTER_LINEAR if picture.ndim == 3 else cv2.INTER_NEAREST
        result = cv2.remap(picture, self.map, None, interpolation, borderMode=cv2.BORDER_REPLICATE)
        result[self.outside] = 0
        return result
