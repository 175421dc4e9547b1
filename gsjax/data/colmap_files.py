"""The files of a COLMAP reconstruction, text and binary: cameras, images and points3D."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.data.errors import COMPLETE, DataError
from gsjax.data.files import read_text
from gsjax.data.lens import Lens
from gsjax.data.photographs import Cloud
from gsjax.data.text import decoded
from gsjax.data.validation import check_quaternions

# Model id of a binary file -> (name, number of parameters).
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
}
_COUNTS = dict(_MODELS.values())
_UNDISTORT = "Run COLMAP's image_undistorter, and give its folder."
AGAIN = "The file may be truncated: fetch or export it again."
_WORDS_BEFORE_NAME, _JUDGED_WORDS = 9, 30
T = TypeVar("T")


class CameraEntry(NamedTuple):
    """A camera of a reconstruction.

    Attributes:
        lens: its calibration.
        width, height: size of its photographs, pixels.
    """

    lens: Lens
    width: int
    height: int


class ImageEntry(NamedTuple):
    """A registered photograph.

    Attributes:
        name: path of its file in the photographs' folder.
        camera: number of its camera.
        viewmat: world to camera, OpenCV axes; NaN without a pose.
    """

    name: str
    camera: int
    viewmat: Float[np.ndarray, "4 4"]


def read_cameras(path: Path) -> dict[int, CameraEntry]:
    """The cameras by number, from cameras.bin or cameras.txt.

    Raises:
        DataError: the file is missing, truncated or malformed, or OpenCV lacks a camera's model.
    """
    return _cameras_bin(path) if path.suffix == ".bin" else _cameras_txt(path)


def read_images(path: Path) -> list[ImageEntry]:
    """The registered photographs in the order of images.bin or images.txt.

    Raises:
        DataError: the file is missing, truncated or malformed.
    """
    return _images_bin(path) if path.suffix == ".bin" else _images_txt(path)


def read_points(path: Path) -> Cloud:
    """The points of points3D.bin or points3D.txt.

    Raises:
        DataError: the file is missing, truncated or malformed.
    """
    return _points_bin(path) if path.suffix == ".bin" else _points_txt(path)


def _lens(path: Path, name: str, p: tuple[float, ...]) -> Lens:
    """The parameters of a COLMAP model in OpenCV's form."""
    if name not in _COUNTS or name in ("FOV", "THIN_PRISM_FISHEYE"):
        known = ", ".join(n for n in _COUNTS if n not in ("FOV", "THIN_PRISM_FISHEYE"))
        raise DataError(path, f"a camera model that OpenCV supports: {known}", name, _UNDISTORT)
    single_focal = name.startswith(("SIMPLE", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if single_focal else p[:4]
    rest = p[3:] if single_focal else p[4:]
    fisheye = name.endswith("FISHEYE")
    wanted = 4 if fisheye else max(4, len(rest))
    coeffs = (*rest, *[0.0] * (wanted - len(rest)))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if not np.isfinite(p).all() or fx <= 0 or fy <= 0:
        raise DataError(
            path, "finite parameters with a positive focal length", f"{name} {list(p)}", "Reconstruct again."
        )
    return Lens(K, coeffs, fisheye)


def _viewmat(
    where: object, name: str, quat: tuple[float, ...], translation: tuple[float, ...]
) -> Float[np.ndarray, "4 4"]:
    """The view matrix of a quaternion w x y z and a translation; all NaN if they do not define a pose.

    Raises:
        DataError: the quaternion's length is neither 0 nor close to 1.
    """
    if not np.isfinite([*quat, *translation]).all() or np.hypot.reduce(quat) < 1e-9:
        return np.full((4, 4), np.nan)
    check_quaternions(np.array([quat]), lambda _: f"{where}, {name}", AGAIN)
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    viewmat[:3, 3] = translation
    return viewmat


class _Bytes:
    """A binary file, read sequentially."""

    def __init__(self, path: Path):
        self.path, self.at = path, 0
        try:
            self.content = path.read_bytes()
        except FileNotFoundError:
            raise DataError(path, "a file of the reconstruction", "no such file", COMPLETE) from None

    def take(self, layout: str) -> tuple:
        layout = f"<{layout}"
        end = self.at + struct.calcsize(layout)
        if end > len(self.content):
            raise self.cut_off()
        values = struct.unpack_from(layout, self.content, self.at)
        self.at = end
        return values

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.content):
            raise self.cut_off()

    def text(self) -> str:
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise self.cut_off()
        raw, self.at = self.content[self.at : end], end + 1
        try:
            return decoded(raw)
        except ValueError:
            raise DataError(self.path, "a COLMAP file", f"the name {raw!r}", AGAIN) from None

    def count(self, least: int) -> int:
        """The number of items that follow, each of at least `least` bytes."""
        (count,) = self.take("Q")
        if count * least > len(self.content) - self.at:
            found = f"{count} items announced in {len(self.content)} bytes"
            raise DataError(self.path, "a COLMAP file", found, AGAIN)
        return count

    def cut_off(self) -> DataError:
        return DataError(
            self.path, "a complete COLMAP file", f"its end after {len(self.content)} bytes", AGAIN
        )


def _cameras_bin(path: Path) -> dict[int, CameraEntry]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(24)):
        number, model, width, height = file.take("iiQQ")
        if model not in _MODELS:
            known = f"one of the camera model ids {sorted(_MODELS)}"
            raise DataError(path, known, f"id {model}", f"{AGAIN} Otherwise: {_UNDISTORT}")
        name, count = _MODELS[model]
        cameras[number] = CameraEntry(_lens(path, name, file.take(f"{count}d")), width, height)
    return cameras


def _images_bin(path: Path) -> list[ImageEntry]:
    file, images = _Bytes(path), []
    for _ in range(file.count(73)):
        _, *pose, camera = file.take("i7di")
        name = file.text()
        file.skip(24 * file.count(24))
        images.append(ImageEntry(name, camera, _viewmat(path, name, tuple(pose[:4]), tuple(pose[4:]))))
    return images


def _points_bin(path: Path) -> Cloud:
    file, points, colors = _Bytes(path), [], []
    for _ in range(file.count(51)):
        _, *values = file.take("Q3d3Bd")
        points.append(values[:3])
        colors.append(values[3:6])
        file.skip(8 * file.count(8))
    return _cloud(points, colors)


def _lines(path: Path) -> list[tuple[int, str]]:
    """The lines with their numbers, without comments."""
    lines = enumerate(read_text(path, "a file of the reconstruction").split("\n"), 1)
    return [(n, line) for n, line in lines if not line.lstrip().startswith("#")]


def _parsed(
    path: Path, number: int, line: str, expected: str, parse: Callable[[list[str]], T], at_most: int = -1
) -> T:
    try:
        return parse(line.split(None, at_most))
    except (ValueError, IndexError):
        raise DataError(f"{path}, line {number}", expected, repr(line[:60]), AGAIN) from None


def _cameras_txt(path: Path) -> dict[int, CameraEntry]:
    cameras = {}
    for number, line in _lines(path):
        if not line.strip():
            continue

        def parse(words: list[str]) -> tuple[int, str, int, int, tuple[float, ...]]:
            return int(words[0]), words[1], int(words[2]), int(words[3]), tuple(map(float, words[4:]))

        which, model, width, height, p = _parsed(
            path, number, line, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", parse
        )
        if len(p) != _COUNTS.get(model, len(p)):
            raise DataError(
                f"{path}, line {number}", f"{_COUNTS[model]} parameters of {model}", f"{len(p)}", AGAIN
            )
        cameras[which] = CameraEntry(_lens(path, model, p), width, height)
    return cameras


def _images_txt(path: Path) -> list[ImageEntry]:
    """A line per image, each usually followed by one of its points, which may be empty or missing."""

    def parse(words: list[str]) -> tuple[str, int, tuple[float, ...], tuple[float, ...]]:
        quat, translation = tuple(map(float, words[1:5])), tuple(map(float, words[5:8]))
        int(words[0])
        return words[9].strip(), int(words[8]), quat, translation

    expected, images, may_be_points = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", [], False
    for number, line in _lines(path):
        if not line.strip():
            continue
        if may_be_points and _is_line_of_points(line):
            may_be_points = False
            continue
        name, camera, *pose = _parsed(path, number, line, expected, parse, _WORDS_BEFORE_NAME)
        images.append(ImageEntry(name, camera, _viewmat(f"{path}, line {number}", name, *pose)))
        may_be_points = True
    return images


def _is_line_of_points(line: str) -> bool:
    """Whether a line consists of (X Y POINT3D_ID), judged by its first words."""
    words = line.split(None, _JUDGED_WORDS)
    complete = len(words) <= _JUDGED_WORDS
    try:
        numbers = [float(word) for word in words[:_JUDGED_WORDS]]
        ids = [int(word) for word in words[2:_JUDGED_WORDS:3]]
    except ValueError:
        return False
    return len(numbers) > 2 and len(ids) > 0 and (not complete or len(words) % 3 == 0)


def _points_txt(path: Path) -> Cloud:
    def parse(words: list[str]) -> list[float]:
        return [float(word) for word in words[1:7]] if len(words) >= 8 else [float("")]

    expected = "POINT3D_ID X Y Z R G B ERROR TRACK"
    rows = [_parsed(path, number, line, expected, parse) for number, line in _lines(path) if line.strip()]
    values = np.array(rows).reshape(-1, 6)
    return _cloud(values[:, :3], values[:, 3:])


def _cloud(points, colors) -> Cloud:
    points, colors = np.reshape(points, (-1, 3)), np.reshape(colors, (-1, 3)) / 255
    finite = np.isfinite(points).all(-1) & np.isfinite(colors).all(-1)
    return Cloud(points[finite], np.clip(colors[finite], 0, 1))
