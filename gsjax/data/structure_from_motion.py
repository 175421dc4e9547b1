"""Where photographs were taken, from nothing but themselves: structure from motion by COLMAP's library.

Features (SIFT, Lowe 2004), matches between pairs checked against two-view geometry, and incremental mapping
(Schönberger, Frahm 2016), each by pycolmap on the CPU. What comes out is what `read_colmap` reads.
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

import numpy as np

from gsjax import extras
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import picture_size, read_image

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Endings of photographs, in lower case."""

_SMALLEST_MODEL = 3  # photographs: two see no scale, and any two share something
_ENOUGH_FOR_CENTER = 20  # photographs by one camera
_NAMED_AT_MOST = 5
_ADVICE = (
    "Take more of them with much overlap, of something with texture that stands still; or try --max-size, "
    "--max-features and --matching exhaustive."
)


@dataclass(frozen=True)
class MotionConfig:
    """How photographs are placed."""

    camera_model: Literal[
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
    ] = "OPENCV"
    """COLMAP's model of the lens: OPENCV has four numbers of distortion, SIMPLE_RADIAL has one, for few
    photographs."""
    share_camera: bool = True
    """Photographs of one size were taken by one camera with one zoom; else each has its own."""
    max_size: int = 1000
    """Features are sought in copies whose longer side has at most so many pixels."""
    max_features: int = 4096
    """Features of a photograph, the strongest ones; matching takes time by their square."""
    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """Which pairs are compared: all, or neighbours in order of name; auto takes neighbours for a video and
    for more than --exhaustive-up-to photographs."""
    exhaustive_up_to: int = 200
    """Photographs of which auto compares all pairs."""
    overlap: int = 10
    """How many of the following photographs each is compared with, and those 1, 2, 4, ... places on."""
    refine_center: bool = True
    """At the end the principal point is found too, where each camera took 20 photographs or more; else it is
    the middle of the picture, which a turn of all cameras makes up for in part."""
    mapping_threads: int = 1
    """Threads of the last stage: with one, the same photographs give the same bits; -1 takes all cores."""
    seed: int = 0
    """Of all that is drawn."""

    def __post_init__(self):
        for name, least in (("max_size", 64), ("max_features", 64), ("exhaustive_up_to", 2), ("overlap", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: expected {least} or more, found {getattr(self, name)}")
        if self.mapping_threads < 1 and self.mapping_threads != -1:
            raise ValueError(f"mapping_threads: expected 1 or more, or -1, found {self.mapping_threads}")


class Placed(NamedTuple):
    """Photographs whose cameras were found.

    Attributes:
        model: pycolmap's Reconstruction, the one with the most photographs.
        names: of the photographs in it, in order.
        left_out: those that are not, in order.
        others: how many photographs each further model has; such models share no scale with the first.
        features: how many each photograph has, by name.
        pairs: how many pairs of photographs show the same things.
        error_px: mean distance of the points from where photographs show them, in their own pixels.
        seconds: what each stage took, by name.
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
        """How many points of the scene there are."""
        return self.model.num_points3D()


def list_photographs(folder: Path) -> list[str]:
    """Names of the photographs in a folder and those within it, in order, relative to it. What cannot be read
    is left out with a DataWarning that names it.

    Raises:
        DataError: there is no such folder, or it has fewer than three photographs that can be read.
    """
    if not folder.is_dir():
        raise DataError(folder, "a folder of photographs or a video", "nothing there", "Check the path.")
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.suffix.lower() in SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    bad = {name: said for name in names if (said := _unreadable(folder / name)) is not None}
    good = [name for name in names if name not in bad]
    if len(good) < _SMALLEST_MODEL:
        found = f"{len(good) or 'none'}" + (f", and {len(bad)} that cannot be read" if bad else "")
        expected = f"{_SMALLEST_MODEL} photographs or more ({', '.join(SUFFIXES)})"
        raise DataError(folder, expected, found, "Give the folder that holds them.")
    if bad:
        first = next(iter(bad.values()))
        message = f"{folder}: {len(bad)} of {len(names)} photographs cannot be read and are left out: {first}"
        warnings.warn(message, DataWarning, stacklevel=2)
    return good


def place_photographs(
    folder: Path,
    names: Sequence[str],
    work: Path,
    config: MotionConfig,
    *,
    in_order: bool = False,
    stage: Callable[[str], AbstractContextManager] = lambda words: nullcontext(),
) -> Placed:
    """The cameras of photographs and the points that they see.

    The world's axes and unit are COLMAP's own choice: photographs alone show neither.

    Args:
        folder: where they lie.
        names: of the photographs, relative to it.
        work: an empty folder for the database, which may be removed afterwards.
        config: how.
        in_order: they are frames of a video.
        stage: entered around each stage with what it does, in words.

    Raises:
        DataError: no photographs could be placed.
        MissingExtra: pycolmap is not installed.
        ValueError: it is too old.
    """
    pycolmap = _pycolmap()
    database, seconds = work / "database.db", {}
    exhaustive = config.matching == "exhaustive" or (
        config.matching == "auto" and not in_order and len(names) <= config.exhaustive_up_to
    )

    def timed(name: str, words: str, call: Callable[[], Any]) -> Any:
        begun = perf_counter()
        with stage(words):
            result = call()
        seconds[name] = perf_counter() - begun
        return result

    timed(
        "features",
        f"finding features in {len(names)} photographs",
        lambda: _extract(pycolmap, database, folder, names, config),
    )
    timed(
        "matching",
        f"comparing {'all pairs' if exhaustive else 'neighbours'}",
        lambda: _match(pycolmap, database, config, exhaustive),
    )
    features, pairs = _counts(pycolmap, database)
    models = timed(
        "mapping",
        "placing photographs",
        lambda: _map(pycolmap, database, folder, work, config),
    )
    models = sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))
    if not models or models[0].num_reg_images() < _SMALLEST_MODEL:
        median = int(np.median(list(features.values())))
        found = f"{pairs} pairs that show the same things, and {median} features in the median photograph"
        raise DataError(folder, "photographs that fit together", found, _ADVICE)
    best = models[0]
    if config.refine_center and _photographs_a_camera(best) >= _ENOUGH_FOR_CENTER:
        timed("refining", "refining cameras", lambda: _refine(pycolmap, best, config))
    registered = sorted(best.images[i].name for i in best.reg_image_ids())
    return Placed(
        model=best,
        names=tuple(registered),
        left_out=tuple(sorted(set(names) - set(registered))),
        others=tuple(model.num_reg_images() for model in models[1:]),
        features=features,
        pairs=pairs,
        error_px=float(best.compute_mean_reprojection_error()),
        seconds=seconds,
    )


def few_of(names: Sequence[str]) -> str:
    """Names as messages have them: the first ones of many."""
    return ", ".join(names[:_NAMED_AT_MOST]) + (", ..." if len(names) > _NAMED_AT_MOST else "")


def _pycolmap() -> Any:
    from PIL import Image  # noqa: F401  (before pycolmap: after it, PIL's PNG writer corrupts the heap)

    pycolmap = extras.load("pycolmap", "poses", "gsjax poses")
    if not hasattr(pycolmap, "FeatureExtractionOptions"):
        raise ValueError("gsjax poses needs pycolmap 4: pip install --upgrade pycolmap")
    # It logs every photograph. What goes wrong is said here.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap


def _unreadable(path: Path) -> str | None:
    """What is wrong with a photograph, or None. COLMAP may stop at one, or pass over it."""
    try:
        read_image(path, *picture_size(path))
    except DataError as error:
        return str(error)
    return None


def _extract(pycolmap, database: Path, folder: Path, names: Sequence[str], config: MotionConfig) -> None:
    how, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    how.max_image_size, how.sift.max_num_features = config.max_size, config.max_features
    reader.camera_model = config.camera_model
    by_size: dict[Any, list[str]] = {}
    for name in names:
        by_size.setdefault(picture_size(folder / name), []).append(name)
    mode = pycolmap.CameraMode.SINGLE if config.share_camera else pycolmap.CameraMode.PER_IMAGE
    pycolmap.Database.open(database).close()  # makes it
    for group in by_size.values():  # one camera has one size
        # Else the threads that find features number the photographs, in the order in which they are ready.
        pycolmap.import_images(database, folder, camera_mode=mode, image_names=group, options=reader)
        pycolmap.extract_features(
            database,
            folder,
            image_names=group,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=how,
            device=pycolmap.Device.cpu,
        )


def _match(pycolmap, database: Path, config: MotionConfig, exhaustive: bool) -> None:
    verified = pycolmap.TwoViewGeometryOptions()
    verified.ransac.random_seed = config.seed
    shared = {"verification_options": verified, "device": pycolmap.Device.cpu}
    if exhaustive:
        pycolmap.match_exhaustive(database, **shared)
    else:
        pairing = pycolmap.SequentialPairingOptions()
        pairing.overlap, pairing.loop_detection = config.overlap, False
        pycolmap.match_sequential(database, pairing_options=pairing, **shared)


def _counts(pycolmap, database: Path) -> tuple[dict[str, int], int]:
    """Features by name, and pairs that passed."""
    with pycolmap.Database.open(database) as opened:
        features = {
            image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()
        }
        _, inliers = opened.read_two_view_geometry_num_inliers()
        return features, sum(count > 0 for count in inliers)


def _map(pycolmap, database: Path, folder: Path, work: Path, config: MotionConfig) -> list[Any]:
    how = pycolmap.IncrementalPipelineOptions()
    how.num_threads = how.mapper.num_threads = config.mapping_threads
    how.random_seed = how.mapper.random_seed = how.triangulation.random_seed = config.seed
    how.min_model_size = _SMALLEST_MODEL
    target = work / "models"
    os.makedirs(target, exist_ok=True)
    return list(pycolmap.incremental_mapping(database, folder, target, how).values())


def _photographs_a_camera(model: Any) -> int:
    """Of the camera that took the fewest."""
    taken = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    return min(taken.values())


def _refine(pycolmap, model: Any, config: MotionConfig) -> None:
    """All of it once more, with the principal points."""
    how = pycolmap.BundleAdjustmentOptions()
    how.refine_principal_point, how.print_summary = True, False
    how.ceres.solver_options.num_threads = config.mapping_threads
    pycolmap.bundle_adjustment(model, how)
