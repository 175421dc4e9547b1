"""The contents of a dataset, a run or a file of Gaussians, as printed by `gsjax info`."""

from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console

from gsjax.data import Photographs, Sequence, open_photographs, open_sequence, photographs_of
from gsjax.data.consistency import check_photographs, check_recording
from gsjax.data.errors import MissingFile
from gsjax.data.open import SIMULATED_PREFIX, ReadOptions, is_dataset_file, is_only_photographs
from gsjax.data.pictures import warn_of_truncated
from gsjax.engine.folder import SCRIPT, is_of_run, is_run
from gsjax.engine.info_picture import by_camera, by_split, write_picture
from gsjax.engine.info_run import describe_film, describe_run
from gsjax.engine.info_scene import describe_frames, describe_scene, origin_fact
from gsjax.engine.messages import Notes
from gsjax.engine.options import Common, Reading
from gsjax.engine.summary import Column, Table
from gsjax.engine.terminal import print_facts, print_table
from gsjax.geometry.sight import radial_table
from gsjax.io.scenes import is_scene
from gsjax.io.sequences import frame_files
from gsjax.methods.fit import extent_of
from gsjax.scene.origin import in_world

PICTURES = (".png", ".svg", ".pdf")
_MOST_CHECKED = 2000  # pictures
MOST_LABELS, MOST_CAMERAS = 8, 6  # in the table of masks


@dataclass(frozen=True)
class Options(Common, Reading):
    """Options of `gsjax info`."""

    path: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET|RUN|FILE")]
    """Folder of a recording or of photographs; a built-in scene such as simulated:tabletop; folder of a run
    or of a film; a file of Gaussians, or a folder of numbered ones."""
    picture: Path | None = None
    """Draw the cameras and the points, from above and from the side, into this file (.png, .svg or .pdf)."""


def run(options: Options) -> int:
    """Print the contents of a dataset, a run or a file of Gaussians.

    Raises:
        DataError, ValueError: it cannot be read, or a picture cannot be written in that format.
    """
    if options.picture is not None and options.picture.suffix not in PICTURES:
        raise ValueError(
            f"--picture: expected a name that ends in {', '.join(PICTURES)}, found {options.picture.name!r}"
        )
    path = Path(options.path)
    if (describe := _scene_at(path)) is not None:
        if options.picture is not None:
            raise ValueError(f"--picture: draws the cameras of a dataset, found none in {path}; leave it out")
        if options.read != ReadOptions():
            raise ValueError(f"--read: is about datasets, and {path} is none; leave it out")
        with Notes(Console(stderr=True, highlight=False)):
            facts = describe()
        print_facts(facts, title=path.absolute().name)
        return 0
    table = None
    with Notes(Console(stderr=True, highlight=False)):
        if is_only_photographs(options.path, options.read.images):
            photographs = open_photographs(options.path, options.read)
            photographs.image(0)  # an error if it cannot be read
            check_photographs(photographs)
            facts, groups = describe_photographs(photographs), by_split
        else:
            sequence = open_sequence(options.path, options.read)
            for c in range(sequence.num_cameras):
                sequence.image(0, c)  # an error if it cannot be read
            check_recording(sequence)
            masks = first_masks(sequence)
            facts, table = describe_sequence(sequence, masks), mask_table(masks, sequence)
            photographs, groups = photographs_of(sequence), lambda _: by_camera(sequence)
        some = np.linspace(0, photographs.num - 1, min(photographs.num, _MOST_CHECKED)).astype(int).tolist()
        warn_of_truncated(photographs.name, [Path(photographs.where("image", i)) for i in some])
        if options.picture is not None:
            write_picture(options.picture, photographs, groups(photographs))
    print_facts(facts, title=photographs.name)
    if table is not None:
        print_table(table)
    if options.picture is not None:
        print(f"\nwrote {options.picture}")
    return 0


def _scene_at(path: Path) -> Callable[[], dict[str, str]] | None:
    """A function that describes the run, the frames or the file of Gaussians at a path; None for a dataset.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: it is a file of a run.
    """
    if is_of_run(path) and not is_scene(path):
        raise ValueError(
            f"{path}: expected a dataset, a run or a file of Gaussians, found a file of a run; give its "
            f"folder, {path.parent}"
        )
    if is_run(path):
        return partial(describe_run, path)
    if (path / SCRIPT).is_file():
        return partial(describe_film, path)
    if files := frame_files(path):
        return partial(describe_frames, files)
    if is_scene(path / "meta.json"):
        return partial(describe_scene, path / "meta.json")
    if path.is_file() and (is_scene(path) or not is_dataset_file(path)):
        return partial(describe_scene, path)
    if not path.exists() and not str(path).startswith(SIMULATED_PREFIX):
        raise FileNotFoundError(
            f"{path}: expected a dataset, a run or a file of Gaussians, found nothing there; check the path"
        )
    return None


def describe_photographs(photographs: Photographs) -> dict[str, str]:
    """Facts about photographs; opens nothing but the first depth image."""
    sizes = Counter(map(tuple, photographs.sizes.tolist()))
    extent = extent_of(photographs.viewmats)
    focus = ", ".join(f"{value:.2f}" for value in in_world(np.asarray(extent.focus), photographs.origin))
    times, splits, cloud = photographs.times, photographs.splits, photographs.cloud
    listed = [f"{w} x {h}" + (f" ({n})" if len(sizes) > 1 else "") for (w, h), n in sizes.most_common(4)]
    depth = "none"
    if photographs.load_depth is not None:
        known = photographs.depth(0)
        valid = None if known is None else _range(known[known > 0])
        depth = "some, none in the first" if valid is None else f"{valid} in the first"
    return {
        **({"layout": photographs.layout} if photographs.layout else {}),
        "photographs": f"{photographs.num}: {photographs.names[0]} to {photographs.names[-1]}",
        "size": ", ".join([*listed, *(["..."] if len(sizes) > 4 else [])]),
        "view": _view(photographs),
        "cameras": f"within {extent.radius:.2f} of their middle, looking at ({focus})",
        **origin_fact(photographs.origin),
        "splits": ", ".join(f"{n} {name}" for name, n in Counter(splits or ()).items()) or "none",
        "points": "none" if cloud is None else f"{len(cloud.points):,}",
        "depth": depth,
        "masks": "none" if photographs.load_mask is None else "yes",
        "times": "none" if times is None else f"{times.min():.3f} to {times.max():.3f} s",
    }


def first_masks(sequence: Sequence) -> dict[int, np.ndarray]:
    """The first mask of each camera that has one, by camera id; cameras without one are left out."""
    masks = {}
    for c, camera in enumerate(sequence.camera_ids):
        with suppress(MissingFile):
            masks[camera] = sequence.mask(0, c)
    return {camera: mask for camera, mask in masks.items() if mask is not None}


def describe_sequence(sequence: Sequence, masks: dict[int, np.ndarray]) -> dict[str, str]:
    """Facts about a recording; opens the first depth images."""
    ids, width = sequence.camera_ids, sequence.width
    moving = np.ptp(sequence.viewmats, axis=0).max(axis=(1, 2)) > 1e-6
    movement = "moving" if moving.all() else f"{moving.sum()} of them moving" if moving.any() else "fixed"
    first, last = sequence.times[0], sequence.times[-1]
    times = f"at {first:.3f} s"
    if sequence.num_frames > 1:
        step = np.median(np.diff(sequence.times))
        times = f"{last - first:.2f} s, every {1e3 * step:.1f} ms ({1 / step:.1f} Hz)"
    labels = ", ".join(map(str, _labels(masks))) or "none but the background"
    return {
        **({"layout": sequence.layout} if sequence.layout else {}),
        "cameras": f"{len(ids)}: {', '.join(map(str, ids))} ({movement})",
        **origin_fact(sequence.origin),
        "image": f"{width} x {sequence.height}, {_fields_of_view(width, sequence.Ks[0])}",
        "frames": f"{sequence.num_frames}, numbered {sequence.frame_ids[0]} to {sequence.frame_ids[-1]}",
        "times": times,
        "depth": _depth(sequence),
        "masks": _masks(masks, labels, sequence),
        "flow": "yes" if sequence.has_flow else "none",
        "truth": _truth(sequence),
        "shapes": ", ".join(f"{m.name} ({len(m.means):,} Gaussians)" for m in sequence.models) or "none",
    }


def mask_table(masks: dict[int, np.ndarray], sequence: Sequence) -> Table | None:
    """The number of pixels of each label in the first masks, a row per camera; None without labels, or with
    too many."""
    labels, names = _labels(masks), sequence.names_of_labels
    if not labels or len(labels) > MOST_LABELS:
        return None
    columns = [Column(f"{label} {names.get(label, '')}".strip(), str(label), "px") for label in labels]
    rows = [
        {"camera": f"camera {camera}"} | {str(label): int((mask == label).sum()) for label in labels}
        for camera, mask in list(masks.items())[:MOST_CAMERAS]
    ]
    return Table("first masks", [Column("", "camera"), *columns], rows)


def _labels(masks: dict[int, np.ndarray]) -> list[int]:
    return sorted({int(value) for mask in masks.values() for value in np.unique(mask)} - {0})


def _cameras(ids: Iterable[int], sequence: Sequence) -> str:
    """Cameras by their ids, or all of them."""
    known = [str(camera) for camera in ids]
    if len(known) == sequence.num_cameras:
        return "all cameras"
    return f"camera{'s' if len(known) > 1 else ''} {', '.join(known)}"


def _view(photographs: Photographs) -> str:
    if photographs.fisheye is None:
        return _fields_of_view(photographs.sizes[:, 0], photographs.Ks)
    views = zip(photographs.sizes[:, 0] / (2 * photographs.Ks[:, 0, 0]), photographs.fisheye, strict=True)
    half = np.array([np.interp(far, *radial_table(coeffs)[::-1]) for far, coeffs in views])
    return f"{_degrees_wide(np.degrees(2 * half))}, by fisheyes"


def _fields_of_view(widths: np.ndarray | int, Ks: Float[np.ndarray, "n 3 3"]) -> str:
    return _degrees_wide(np.degrees(2 * np.arctan(widths / (2 * Ks[:, 0, 0]))))


def _degrees_wide(degrees: Float[np.ndarray, "n"]) -> str:
    low, high = degrees.min(), degrees.max()
    return f"{low:.0f}° wide" if high - low < 1 else f"{low:.0f}° to {high:.0f}° wide"


def _depth(sequence: Sequence) -> str:
    depths = {camera: sequence.depth(0, c) for c, camera in enumerate(sequence.camera_ids)}
    known = {camera: depth for camera, depth in depths.items() if depth is not None}
    if not known:
        return "none"
    found = _range(np.concatenate([depth[depth > 0] for depth in known.values()]))
    what = "but no pixel of the first frame is valid" if found is None else f"{found} m in the first frame"
    return f"{_cameras(known, sequence)}, {what}"


def _masks(masks: dict[int, np.ndarray], labels: str, sequence: Sequence) -> str:
    if masks:
        return f"{_cameras(masks, sequence)}, labels {labels} in the first frame"
    return "none" + (
        " (gsjax track finds objects itself, or takes --masks PICTURE)" if sequence.has_depth else ""
    )


def _range(values: Float[np.ndarray, "n"]) -> str | None:
    """The 1st and 99th percentile; None without values."""
    return "{:.2f} to {:.2f}".format(*np.percentile(values, [1, 99])) if len(values) else None


def _truth(sequence: Sequence) -> str:
    truth = sequence.truth
    if truth is None:
        return "none"
    named = [f"{name} (label {label})" for name, label in zip(truth.names, truth.label_ids, strict=True)]
    known = ["poses of " + ", ".join(named)] if named else []
    known += [] if truth.robot is None else [f"robot (label {truth.robot})"]
    known += [] if truth.tracks is None else [f"tracks of {truth.tracks.shape[1]:,} points"]
    return "; ".join(known)
