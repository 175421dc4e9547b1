"""COLMAP reconstructions (Schönberger, Frahm 2016), text and binary: world to camera, OpenCV axes.

cameras    CAMERA_ID MODEL WIDTH HEIGHT PARAMS...          pixels, centres at +0.5
images     IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME    and a line of (X Y POINT3D_ID)
points3D   POINT3D_ID X Y Z R G B ERROR TRACK...

Each is a .txt or .bin file (little endian; lengths as uint64) in sparse/0, sparse or the folder itself; the
photographs are in images. If sparse holds several reconstructions, one has to be chosen. Some exporters
leave out the lines of points in images.txt. The layouts are described at colmap.github.io/format.html.
"""

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsjax.data.clouds import find_cloud, read_cloud
from gsjax.data.colmap_files import AGAIN, CameraEntry, ImageEntry, read_cameras, read_images, read_points
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import BLACK, find_background, picture_size, read_image
from gsjax.data.lens import scaled_intrinsics
from gsjax.data.masks import read_shades
from gsjax.data.names import find_file, portable
from gsjax.data.origin import near_origin
from gsjax.data.photographs import Cloud, Photographs
from gsjax.data.pictures import reject_unread
from gsjax.data.through_lenses import Fisheye, through_lenses
from gsjax.io.brief import shortened

PLACES = ("sparse", "colmap/sparse", ".")
"""Subfolders that may hold the three files, or numbered folders of them, in search order."""

_FILES = ("cameras", "images")  # without which there is no reconstruction


class Model(NamedTuple):
    """The files of one reconstruction.

    Attributes:
        folder: where they lie.
        cameras, images: the two files that every reconstruction has.
        points: the file of its points; None if there is none.
    """

    folder: Path
    cameras: Path
    images: Path
    points: Path | None


@near_origin
def read_colmap(
    path: str | Path, images: str = "images", model: str | None = None, fisheye: Fisheye = "undistort"
) -> Photographs:
    """The registered photographs of a reconstruction, sorted by name, and its points.

    Photographs whose file is missing or whose pose is not finite are left out, with a DataWarning that counts
    them. Distorted photographs are undistorted (see `gsjax.data.lens`); transparent ones are composited on
    white.

    Args:
        path: the folder that holds the photographs' folder and sparse/0, sparse or the files themselves.
        images: name of the photographs' folder in it; masks/NAME.png beside it mark the pixels that count.
        model: folder of the reconstruction, such as "sparse/1"; None: the one with the most photographs, and
            a DataWarning that names the others.
        fisheye: whether fisheye photographs are undistorted or kept.

    Raises:
        DataError: a file is missing, truncated or malformed, no photograph is left, a camera has a model
            that OpenCV does not support, or fisheyes are to be kept and not all lenses are fisheyes.
    """
    root = Path(path)
    chosen = _largest(root, find_models(root)) if model is None else _named(root, model)
    cameras = read_cameras(chosen.cameras)
    registered = sorted(read_images(chosen.images), key=lambda image: image.name)
    for file, entries in ((chosen.cameras, cameras), (chosen.images, registered)):
        if not entries:
            advice = "Did the reconstruction fail? Give another model, or reconstruct again."
            raise DataError(file, "at least one entry", "none", advice)
    cloud = None if chosen.points is None else read_points(chosen.points)
    if cloud is None and (points := find_cloud(chosen.folder)) is not None:
        cloud = read_cloud(points)
    usable = [image for image in registered if np.isfinite(image.viewmat).all()]
    files = [find_file(root / images, image.name) for image in usable]
    left_out = []
    if missing := [image.name for image, file in zip(usable, files, strict=True) if file is None]:
        left_out.append(f"{len(missing)} not in {root / images} ({shortened(missing)})")
    if lost := [image.name for image in registered if not np.isfinite(image.viewmat).all()]:
        left_out.append(f"{len(lost)} without a finite pose in {chosen.images.name} ({shortened(lost)})")
    kept = [(image, file) for image, file in zip(usable, files, strict=True) if file is not None]
    if not kept:
        if (root / images).is_dir():
            reject_unread(root / images, "registered photographs", (root / images).rglob("*"))
        found = f"{len(registered)} registered, {' and '.join(left_out)}"
        advice = "Did the reconstruction fail? Give another model, or reconstruct again."
        if missing:
            advice = (
                f"Give the folder that holds both {images} (or --read.images NAME) and the reconstruction."
            )
            above = list(root.parents)[:3] if chosen.folder == root else []
            if holder := next((folder for folder in above if find_file(folder / images, missing[0])), None):
                advice = f"Give the folder above, which has them: {holder}."
        raise DataError(chosen.folder, "registered photographs that can be used", found, advice)
    if left_out:
        message = f"{root}: of {len(registered)} registered photographs, {' and '.join(left_out)}"
        warnings.warn(f"{message} are left out", DataWarning, stacklevel=2)
    for image, _ in kept:
        if image.camera not in cameras:
            expected = f"one of the cameras {sorted(cameras)[:8]}"
            raise DataError(chosen.images, expected, f"{image.camera} for {image.name}", AGAIN)
    return _photographs(root, kept, cameras, cloud, fisheye)


def find_models(root: Path) -> list[Model]:
    """The reconstructions in a folder, from the first of `PLACES` that has any, in order of their numbers."""
    for folders in _folders(root):
        if models := [model for folder in folders if (model := _model_in(folder)) is not None]:
            return models
    return []


def find_missing_file(root: Path) -> Path | None:
    """The missing file of an incomplete reconstruction; None if there is no incomplete reconstruction."""
    for folder in (folder for folders in _folders(root) for folder in folders):
        for suffix in (".bin", ".txt"):
            present = [(folder / f"{name}{suffix}").is_file() for name in _FILES]
            if any(present) and _model_in(folder) is None:
                return folder / f"{_FILES[present.index(False)]}{suffix}"
    return None


def _folders(root: Path) -> list[list[Path]]:
    """Folders that may hold a reconstruction: those inside each place, 2 before 10, and the place itself."""
    groups = []
    for place in PLACES:
        inside = [] if place == "." or not (root / place).is_dir() else (root / place).iterdir()
        numbered = [folder for folder in inside if folder.is_dir() and not folder.name.startswith(".")]
        groups.append([*sorted(numbered, key=_number_first), root / place])
    return groups


def _number_first(folder: Path) -> tuple[float, str]:
    return (int(folder.name) if re.fullmatch(r"\d{1,9}", folder.name) else np.inf), folder.name


def _model_in(folder: Path) -> Model | None:
    """The files of a folder: all binary, else all text, else whichever exist."""

    def present(name: str, suffix: str) -> bool:
        return (folder / f"{name}{suffix}").is_file()

    preferred = [suffix for suffix in (".bin", ".txt") if all(present(name, suffix) for name in _FILES)]
    suffixes = (*preferred, ".bin", ".txt")
    files = [
        next((folder / f"{name}{suffix}" for suffix in suffixes if present(name, suffix)), None)
        for name in (*_FILES, "points3D")
    ]
    cameras, images, points = files
    return None if cameras is None or images is None else Model(folder, cameras, images, points)


def _named(root: Path, name: str) -> Model:
    """The reconstruction of this name: a path in the folder, or in one of `PLACES`."""
    models = (_model_in(root / place / name) for place in (".", *PLACES))
    if (model := next((model for model in models if model is not None), None)) is not None:
        return model
    others = ", ".join(_name(root, model) for model in find_models(root)) or "none"
    found = f"no such files there; the reconstructions are: {others}"
    raise DataError(root / name, "cameras.bin or cameras.txt, and images", found, "Set model (--read.model).")


def _name(root: Path, model: Model) -> str:
    return model.folder.relative_to(root).as_posix()


def _largest(root: Path, models: list[Model]) -> Model:
    """The reconstruction with the most photographs, the first of equals. Warns if there are others."""
    if not models:
        expected = "cameras.bin or cameras.txt in sparse/0, sparse or here"
        raise DataError(root, expected, "neither", "Pass its folder.")
    if len(models) == 1:
        return models[0]
    counts = [_count(model) for model in models]
    best = counts.index(max(counts))
    others = ", ".join(
        f"{_name(root, model)} ({'unreadable' if count < 0 else count})"
        for i, (model, count) in enumerate(zip(models, counts, strict=True))
        if i != best
    )
    read = f"{_name(root, models[best])} with {counts[best]} photographs is read"
    message = f"{root}: of {len(models)} reconstructions, {read}; left out: {others}"
    warnings.warn(f"{message}. Set model (--read.model) to read another", DataWarning, stacklevel=3)
    return models[best]


def _count(model: Model) -> int:
    try:
        return len(read_images(model.images))
    except DataError:
        return -1


def _photographs(
    root: Path,
    kept: list[tuple[ImageEntry, Path]],
    cameras: dict[int, CameraEntry],
    cloud: Cloud | None,
    fisheye: Fisheye,
) -> Photographs:
    entries, paths = [image for image, _ in kept], [file for _, file in kept]
    sizes = [picture_size(path) for path in paths]
    taken_by = [cameras[image.camera] for image in entries]
    lenses = [
        camera.lens._replace(K=scaled_intrinsics(camera.lens.K, (camera.width, camera.height), size, path))
        for camera, size, path in zip(taken_by, sizes, paths, strict=True)
    ]
    seen = through_lenses(lenses, sizes, root, fisheye)
    masks = [_mask_of(root / "masks", image.name) for image in entries]
    background = find_background(paths)
    behind = background or BLACK

    def load_mask(i: int) -> np.ndarray | None:
        mask = masks[i]
        return seen.mask(i, None if mask is None else read_shades(mask, *sizes[i]))

    return Photographs(
        name=root.resolve().name,
        names=tuple(portable(image.name) for image in entries),
        sizes=np.array(sizes),
        Ks=seen.Ks,
        viewmats=np.stack([image.viewmat for image in entries]),
        load_image=lambda i: seen.image(i, read_image(paths[i], *sizes[i], behind)),
        load_mask=load_mask if any(masks) or seen.has_edges else None,
        cloud=cloud,
        background=background,
        fisheye=seen.fisheye,
        locate=lambda kind, i: str(masks[i] if kind == "mask" else paths[i]),
    )


def _mask_of(folder: Path, name: str) -> Path | None:
    """The mask of a photograph, if any: COLMAP names that of a.jpg a.jpg.png, other tools a.png."""
    if not folder.is_dir():
        return None
    return find_file(folder, f"{name}.png") or find_file(
        folder, str(Path(portable(name)).with_suffix(".png"))
    )
