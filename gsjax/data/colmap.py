"""COLMAP reconstructions (Schönberger, Frahm 2016), text and binary: world to camera, OpenCV axes.

cameras    CAMERA_ID MODEL WIDTH HEIGHT PARAMS...          pixels, centres at +0.5
images     IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME    and a line of (X Y POINT3D_ID)
points3D   POINT3D_ID X Y Z R G B ERROR TRACK...

Each is a .txt or .bin file (little endian; lengths as uint64) in sparse/0, sparse or the folder itself; the
photographs are in images. The layouts are described at colmap.github.io/format.html.
"""

import os
import struct
import warnings
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gsjax.data.clouds import find_cloud, read_cloud
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import picture_size, read_image, read_mask
from gsjax.data.lens import Lens, scaled_intrinsics, undistort
from gsjax.data.photographs import Cloud, Photographs

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Subfolders in which the three files may lie, in the order in which they are searched."""

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
_UNIT_TOLERANCE = 0.01  # on a quaternion's length: text files often have few digits
_COUNTS = dict(_MODELS.values())
_UNDISTORT = "Run COLMAP's image_undistorter, and give its folder."
_AGAIN = "The file may be truncated: fetch or export it again."


class _Camera(NamedTuple):
    lens: Lens
    width: int
    height: int


class _Image(NamedTuple):
    name: str
    camera: int
    viewmat: Float[np.ndarray, "4 4"]


def read_colmap(path: str | Path, images: str = "images") -> Photographs:
    """The registered photographs of a reconstruction, sorted by name, and its points.

    Photographs whose file is missing or whose pose is not finite are left out, with a DataWarning that counts
    them. Distorted photographs are undistorted (see `gsjax.data.lens`).

    Args:
        path: the folder that holds the photographs' folder and sparse/0, sparse or the files themselves.
        images: name of the photographs' folder in it; masks/NAME.png beside it mark the pixels that count.

    Raises:
        DataError: a file is missing, truncated or malformed, no photograph is left, or a camera has a model
            that OpenCV does not support.
    """
    root = Path(path)
    model = next((root / place for place in PLACES if find(root / place)), None)
    if model is None:
        raise DataError(
            root, "cameras.bin or cameras.txt in sparse/0, sparse or here", "neither", "Pass its folder."
        )
    suffix = find(model)
    cameras = _READERS[suffix]["cameras"](model / f"cameras{suffix}")
    registered = sorted(_READERS[suffix]["images"](model / f"images{suffix}"), key=lambda image: image.name)
    for what, entries in (("cameras", cameras), ("images", registered)):
        if not entries:
            expected, advice = (
                "at least one entry",
                "Did the reconstruction fail? Give another model, or reconstruct again.",
            )
            raise DataError(model / f"{what}{suffix}", expected, "none", advice)
    cloud = (
        _READERS[suffix]["points3D"](model / f"points3D{suffix}")
        if (model / f"points3D{suffix}").exists()
        else None
    )
    if cloud is None and (points := find_cloud(model)) is not None:
        cloud = read_cloud(points)
    usable = [image for image in registered if np.isfinite(image.viewmat).all()]
    kept = [image for image in usable if os.path.isfile(root / images / image.name)]
    left_out = []
    if missing := [image.name for image in usable if not os.path.isfile(root / images / image.name)]:
        left_out.append(f"{len(missing)} not in {root / images} ({_first(missing)})")
    if lost := [image.name for image in registered if not np.isfinite(image.viewmat).all()]:
        left_out.append(f"{len(lost)} without a finite pose in images{suffix} ({_first(lost)})")
    if not kept:
        found = f"{len(registered)} registered, {' and '.join(left_out)}"
        advice = f"If their folder is not {images}, give its name."
        raise DataError(model, "registered photographs that can be used", found, advice)
    if left_out:
        message = f"{root}: of {len(registered)} registered photographs, {' and '.join(left_out)}"
        warnings.warn(f"{message} are left out", DataWarning, stacklevel=2)
    for image in kept:
        if image.camera not in cameras:
            known = sorted(cameras)[:8]
            raise DataError(
                model / f"images{suffix}",
                f"one of the cameras {known}",
                f"{image.camera} for {image.name}",
                _AGAIN,
            )
    return _photographs(root, root / images, kept, cameras, cloud)


def _first(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")


def find(folder: Path) -> str | None:
    """The suffix of the reconstruction files in a folder, ".bin" or, if there are none, ".txt"; or None."""
    present = (
        suffix
        for suffix in (".bin", ".txt")
        if all((folder / f"{n}{suffix}").is_file() for n in ("cameras", "images"))
    )
    return next(present, None)


def find_missing_file(root: Path) -> Path | None:
    """The missing file of an incomplete reconstruction; None if there is no incomplete reconstruction."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            files = [root / place / f"{name}{suffix}" for name in ("cameras", "images")]
            present = [file.is_file() for file in files]
            if any(present) and not all(present):
                return files[present.index(False)]
    return None


def _photographs(root, folder, images, cameras, cloud) -> Photographs:
    paths = [folder / image.name for image in images]
    sizes = [picture_size(path) for path in paths]
    taken_by = [cameras[image.camera] for image in images]
    lenses = [
        camera.lens._replace(K=scaled_intrinsics(camera.lens.K, (camera.width, camera.height), size, path))
        for camera, size, path in zip(taken_by, sizes, paths, strict=True)
    ]
    ideal = [undistort(lens, *size) for lens, size in zip(lenses, sizes, strict=True)]
    masks = [
        next((m for m in _mask_names(root / "masks", image.name) if m.is_file()), None) for image in images
    ]

    def load_mask(i: int) -> np.ndarray | None:
        if masks[i] is None:
            return None
        mask = (read_mask(masks[i], *sizes[i]) != 0).astype(np.uint8)
        return ideal[i][1](mask, cv2.INTER_NEAREST) > 0

    return Photographs(
        name=root.resolve().name,
        names=tuple(image.name for image in images),
        sizes=np.array(sizes),
        Ks=np.stack([K for K, _ in ideal]),
        viewmats=np.stack([image.viewmat for image in images]),
        load_image=lambda i: ideal[i][1](read_image(paths[i], *sizes[i]), cv2.INTER_LINEAR),
        load_mask=load_mask if any(masks) else None,
        cloud=cloud,
        locate=lambda kind, i: str(masks[i] if kind == "mask" else paths[i]),
    )


def _mask_names(folder: Path, name: str) -> tuple[Path, Path]:
    """COLMAP names the mask of a.jpg a.jpg.png; other tools name it a.png."""
    return folder / f"{name}.png", (folder / name).with_suffix(".png")


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
    if not np.isfinite([*quat, *translation]).all() or (length := np.hypot.reduce(quat)) < 1e-9:
        return np.full((4, 4), np.nan)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise DataError(
            where, f"a unit quaternion for {name}", f"{list(quat)} of length {length:.3g}", _AGAIN
        )
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
            raise DataError(
                path, "a file of the reconstruction", "no such file", "Was the folder copied completely?"
            ) from None

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
        name = self.content[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return name

    def count(self, least: int) -> int:
        """The number of items that follow, each of at least `least` bytes."""
        (count,) = self.take("Q")
        if count * least > len(self.content) - self.at:
            found = f"{count} items announced in {len(self.content)} bytes"
            raise DataError(self.path, "a COLMAP file", found, _AGAIN)
        return count

    def cut_off(self) -> DataError:
        return DataError(
            self.path, "a complete COLMAP file", f"its end after {len(self.content)} bytes", _AGAIN
        )


def _cameras_bin(path: Path) -> dict[int, _Camera]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.count(24)):
        number, model, width, height = file.take("iiQQ")
        if model not in _MODELS:
            known = f"one of the camera model ids {sorted(_MODELS)}"
            raise DataError(path, known, f"id {model}", f"{_AGAIN} Otherwise: {_UNDISTORT}")
        name, count = _MODELS[model]
        cameras[number] = _Camera(_lens(path, name, file.take(f"{count}d")), width, height)
    return cameras


def _images_bin(path: Path) -> list[_Image]:
    file, images = _Bytes(path), []
    for _ in range(file.count(73)):
        _, *pose, camera = file.take("i7di")
        name = file.text()
        file.skip(24 * file.count(24))
        images.append(_Image(name, camera, _viewmat(path, name, tuple(pose[:4]), tuple(pose[4:]))))
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
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        raise DataError(
            path, "a file of the reconstruction", "no such file", "Was the folder copied completely?"
        ) from None
    return [(n, line) for n, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]


def _parsed(path: Path, number: int, line: str, expected: str, parse):
    try:
        return parse(line.split())
    except (ValueError, IndexError):
        raise DataError(f"{path}, line {number}", expected, repr(line[:60]), _AGAIN) from None


def _cameras_txt(path: Path) -> dict[int, _Camera]:
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
                f"{path}, line {number}", f"{_COUNTS[model]} parameters of {model}", f"{len(p)}", _AGAIN
            )
        cameras[which] = _Camera(_lens(path, model, p), width, height)
    return cameras


def _images_txt(path: Path) -> list[_Image]:
    """Two lines per image, of which the second, its points, may be empty."""
    lines = _lines(path)
    while lines and not lines[0][1].strip():
        lines.pop(0)

    def parse(words: list[str]) -> tuple[str, int, tuple[float, ...], tuple[float, ...]]:
        quat, translation = tuple(map(float, words[1:5])), tuple(map(float, words[5:8]))
        return " ".join(words[9:]) or words[9], int(words[8]), quat, translation

    expected, images = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", []
    for number, line in lines[::2]:
        if line.strip():
            name, camera, *pose = _parsed(path, number, line, expected, parse)
            images.append(_Image(name, camera, _viewmat(f"{path}, line {number}", name, *pose)))
    return images


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


_READERS = {
    ".bin": {"cameras": _cameras_bin, "images": _images_bin, "points3D": _points_bin},
    ".txt": {"cameras": _cameras_txt, "images": _images_txt, "points3D": _points_txt},
}
