"""Camera poses from photographs alone: structure from motion with COLMAP's library.

Features (SIFT, Lowe 2004), pairwise matches verified against two-view geometry, and incremental mapping
(Schönberger, Frahm 2016), each by pycolmap on the CPU. `read_colmap` reads the result.
"""

import os
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

from gsjax import extras
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import WHITE, picture_size, read_image
from gsjax.data.pictures import SUFFIXES, is_picture, is_web_format, reject_unread

_SMALLEST_MODEL = 3  # photographs: two fix no scale, and almost any two have some matches
_ENOUGH_FOR_CENTER = 20  # photographs per camera
_ADVICE = (
    "Take more photographs with more overlap, of a textured scene in which nothing moves; or try --max-size, "
    "--max-features and --matching exhaustive."
)


@dataclass(frozen=True)
class MotionConfig:
    """Options of structure from motion."""

    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
    ] = "OPENCV"
    """COLMAP's lens model: OPENCV has four distortion coefficients; SIMPLE_RADIAL has one and suits small
    sets of photographs."""
    share_camera: bool = True
    """Treat photographs of the same size as taken by one camera at one zoom; otherwise each has a camera of
    its own."""
    max_size: int = 1000
    """Features are detected in copies downscaled so that the longer side has at most this many pixels."""
    max_features: int = 4096
    """Largest number of features per photograph, strongest first; matching time grows with its square."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are matched: all of them, or neighbours in order of name; auto matches neighbours for a
    video and for more than --exhaustive-up-to photographs."""
    exhaustive_up_to: int = 200
    """Largest number of photographs for which auto matches all pairs."""
    overlap: int = 10
    """In sequential matching, how many of the following photographs each one is matched with, besides those
    1, 2, 4, ... places later."""
    refine_center: bool = True
    """Finally refine the principal point too, if each camera took 20 photographs or more; otherwise it stays
    at the image centre, for which a rotation of all cameras partly compensates."""
    mapping_threads: int = 1
    """Threads of the mapping stage: with 1, results are bitwise reproducible; -1 uses all cores."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self):
        for name, least in (("max_size", 64), ("max_features", 64), ("exhaustive_up_to", 2), ("overlap", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more, found {getattr(self, name)}")
        if self.mapping_threads < 1 and self.mapping_threads != -1:
            raise ValueError(f"mapping_threads: expected 1 or more, or -1, found {self.mapping_threads}")


class SfmResult(NamedTuple):
    """The result of structure from motion.

    Attributes:
        model: the pycolmap Reconstruction with the most registered photographs.
        names: names of the photographs registered in it, sorted.
        left_out: names of the photographs that are not, sorted.
        others: number of photographs in each further model; these models share no scale with the first.
        features: number of features of each photograph, by name.
        pairs: number of photograph pairs with verified matches.
        error_px: mean reprojection error of the points, pixels of the original photographs.
        seconds: duration of each stage, by name.
    """

    model: Any
    names: tuple[str, ...]
    left_out: tuple[str, ...]
    others: tuple[int, ...]
    features: dict[str, int]
    pairs: int
    error_px: float
    seconds: dict[str, float]

    @property
    def points(self) -> int:
        """Number of 3D points in the model."""
        return self.model.num_points3D()


def list_photographs(folder: Path) -> list[str]:
    """Names of the photographs in a folder and its subfolders, sorted, relative to the folder. Files that
    cannot be read are left out with a DataWarning.

    Raises:
        DataError: there is no such folder, or it has fewer than three photographs that can be read.
    """
    if not folder.is_dir():
        raise DataError(folder, "a folder of photographs or a video", "nothing there", "Check the path.")
    inside = (path.relative_to(folder) for path in folder.rglob("*"))
    shown = [name for name in inside if not any(part.startswith(".") for part in name.parts)]  # no thumbnails
    files = [folder / name for name in shown if (folder / name).is_file()]
    names = sorted(path.relative_to(folder).as_posix() for path in files if is_picture(path))
    expected = f"{_SMALLEST_MODEL} photographs or more ({', '.join(SUFFIXES)})"
    reject_unread(folder, expected, files, others=len(names))
    bad = {name: reason for name in names if (reason := _unreadable(folder / name)) is not None}
    good = [name for name in names if name not in bad]
    if len(good) < _SMALLEST_MODEL:
        found = f"{len(good) or 'none'}" + (f", and {len(bad)} that cannot be read" if bad else "")
        raise DataError(folder, expected, found, "Give the folder that holds them.")
    if bad:
        first = next(iter(bad.values()))
        message = f"{folder}: {len(bad)} of {len(names)} photographs cannot be read and are left out: {first}"
        warnings.warn(message, DataWarning, stacklevel=2)
    return good


def reconstruct_cameras(
    folder: Path,
    names: Sequence[str],
    work: Path,
    config: MotionConfig,
    *,
    in_order: bool = False,
    stage: Callable[[str], AbstractContextManager] = lambda description: nullcontext(),
) -> SfmResult:
    """Estimate the cameras of photographs and the 3D points that they see.

    The world's axes and unit are arbitrary, as COLMAP chooses them: photographs alone determine neither.

    Args:
        folder: the folder of the photographs.
        names: names of the photographs, relative to `folder`.
        work: an empty folder for the database, which may be removed afterwards.
        config: the options.
        in_order: the photographs are consecutive frames of a video.
        stage: context manager entered around each stage, called with a description of it.

    Raises:
        DataError: fewer than three photographs could be registered together.
        MissingExtra: pycolmap is not installed.
        ValueError: pycolmap is too old.
    """
    pycolmap = _pycolmap()
    database, seconds = work / "database.db", {}
    folder = _as_colmap_reads(folder, names, work / "readable")
    exhaustive = config.matching == "exhaustive" or (
        config.matching == "auto" and not in_order and len(names) <= config.exhaustive_up_to
    )

    def timed(name: str, description: str, call: Callable[[], Any]) -> Any:
        start = perf_counter()
        with stage(description):
            result = call()
        seconds[name] = perf_counter() - start
        return result

    timed(
        "features",
        f"finding features in {len(names)} photographs",
        lambda: _extract(pycolmap, database, folder, names, config),
    )
    timed(
        "matching",
        f"matching {'all pairs' if exhaustive else 'neighbours'}",
        lambda: _match(pycolmap, database, config, exhaustive),
    )
    features, pairs = _counts(pycolmap, database)
    models = timed(
        "mapping",
        "registering photographs",
        lambda: _map(pycolmap, database, folder, work, config),
    )
    models = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if not models or models[0].num_reg_images() < _SMALLEST_MODEL:
        median = int(np.median(list(features.values())))
        found = f"{pairs} pairs with verified matches, and {median} features in the median photograph"
        raise DataError(folder, "photographs that can be registered together", found, _ADVICE)
    best = models[0]
    if config.refine_center and _fewest_photographs_per_camera(best) >= _ENOUGH_FOR_CENTER:
        timed("refining", "refining cameras", lambda: _refine(pycolmap, best, config))
    registered = sorted(best.images[i].name for i in best.reg_image_ids())
    return SfmResult(
        model=best,
        names=tuple(registered),
        left_out=tuple(sorted(set(names) - set(registered))),
        others=tuple(model.num_reg_images() for model in models[1:]),
        features=features,
        pairs=pairs,
        error_px=float(best.compute_mean_reprojection_error()),
        seconds=seconds,
    )


def _pycolmap() -> Any:
    from PIL import Image  # noqa: F401  (before pycolmap: after it, PIL's PNG writer corrupts the heap)

    pycolmap = extras.load("pycolmap", "poses", "gsjax poses")
    if not hasattr(pycolmap, "FeatureExtractionOptions"):
        raise ValueError("gsjax poses needs pycolmap 4: pip install --upgrade pycolmap")
    # By default it logs every photograph. Failures are reported here instead.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap


def _unreadable(path: Path) -> str | None:
    """Why a photograph cannot be read, or None. COLMAP would stop at such a file, or skip it silently."""
    try:
        read_image(path, *picture_size(path))
    except DataError as error:
        return str(error)
    return None


def _as_colmap_reads(folder: Path, names: Sequence[str], copy: Path) -> Path:
    """The folder of the photographs, or one of links and copies if some are in a format that COLMAP lacks."""
    lacking = {name for name in names if is_web_format(folder / name)}
    if not lacking:
        return folder
    for name in names:
        source, target = (folder / name).resolve(), copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in lacking:  # COLMAP recognises formats by content
            picture = read_image(source, *picture_size(source), WHITE)
            target.write_bytes(cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes())
        else:
            target.symlink_to(source)
    return copy


def _extract(pycolmap, database: Path, folder: Path, names: Sequence[str], config: MotionConfig) -> None:
    extraction, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    extraction.max_image_size, extraction.sift.max_num_features = config.max_size, config.max_features
    reader.camera_model = config.camera_model
    by_size: dict[Any, list[str]] = {}
    for name in names:
        by_size.setdefault(picture_size(folder / name), []).append(name)
    mode = pycolmap.CameraMode.SINGLE if config.share_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.Database.open(database).close()  # creates it
    for group in by_size.values():  # a camera has one image size
        # Import first: otherwise image ids depend on the order in which the extraction threads finish.
        pycolmap.import_images(database, folder, camera_mode=mode, image_names=group, options=reader)
        pycolmap.extract_features(
            database,
            folder,
            image_names=group,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )


def _match(pycolmap, database: Path, config: MotionConfig, exhaustive: bool) -> None:
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = config.seed
    shared = {"verification_options": verification, "device": pycolmap.Device.cpu}
    if exhaustive:
        pycolmap.match_exhaustive(database, **shared)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.loop_detection = config.overlap, False
        pycolmap.match_sequential(database, pairing_options=pairing, **shared)


def _counts(pycolmap, database: Path) -> tuple[dict[str, int], int]:
    """Number of features of each photograph, by name, and number of verified pairs."""
    with pycolmap.Database.open(database) as opened:
        features = {
            image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()
        }
        _, inliers = opened.read_two_view_geometry_num_inliers()
        return features, sum(count > 0 for count in inliers)


def _map(pycolmap, database: Path, folder: Path, work: Path, config: MotionConfig) -> list[Any]:
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = config.mapping_threads
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = config.seed
    options.min_model_size = _SMALLEST_MODEL
    target = work / "models"
    os.makedirs(target, exist_ok=True)
    return list(pycolmap.incremental_mapping(database, folder, target, options).values())


def _fewest_photographs_per_camera(model: Any) -> int:
    """Number of photographs by the camera that took the fewest."""
    taken = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    return min(taken.values())


def _refine(pycolmap, model: Any, config: MotionConfig) -> None:
    """One more bundle adjustment of the whole model, principal points included."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point, options.print_summary = True, False
    options.ceres.solver_options.num_threads = config.mapping_threads
    pycolmap.bundle_adjustment(model, options)
