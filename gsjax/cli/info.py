"""`gsjax info`: what is understood of a recording or of photographs, before anything is made of them."""

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from gsjax.data import Photographs, Sequence, open_photographs, open_sequence, photographs_of
from gsjax.data.errors import MissingFile
from gsjax.data.open import is_photographs, is_recording
from gsjax.engine.folder import expect_dataset
from gsjax.engine.info_picture import by_camera, by_split, write_picture
from gsjax.engine.messages import Notes
from gsjax.engine.options import Common, OneDataset, Reading
from gsjax.methods.fit import extent_of

PICTURES = (".png", ".svg", ".pdf")
MOST_LABELS, MOST_CAMERAS = 8, 6  # that a table of masks shows


@dataclass(frozen=True)
class Options(Common, Reading, OneDataset):
    """What `gsjax info` is told."""

    picture: Path | None = None
    """Draw the cameras and the points, from above and from the side, into this file (.png, .svg or .pdf)."""


def run(options: Options) -> int:
    """Print what a recording holds.

    Raises:
        DataError, ValueError: it cannot be read, or a picture cannot be of that kind.
    """
    if options.picture is not None and options.picture.suffix not in PICTURES:
        raise ValueError(
            f"--picture: expected a name that ends in {', '.join(PICTURES)}, found {options.picture.name!r}"
        )
    expect_dataset(options.dataset)
    if is_photographs(options.dataset) and not is_recording(options.dataset):
        return _print_photographs(options)
    with Notes(Console(stderr=True, highlight=False)):
        sequence = open_sequence(options.dataset, options.read)
        for c in range(sequence.num_cameras):
            sequence.image(0, c)  # says what is wrong with it
        masks = first_masks(sequence)
        if options.picture is not None:
            write_picture(options.picture, photographs_of(sequence), by_camera(sequence))
    console = _print(sequence.name, describe_sequence(sequence, masks))
    pixels = mask_table(masks, sequence)
    if pixels is not None:
        console.print()
        console.print(pixels)
    _say_picture(console, options)
    return 0


def _print_photographs(options: Options) -> int:
    with Notes(Console(stderr=True, highlight=False)):
        photographs = open_photographs(options.dataset, options.read)
        photographs.image(0)  # says what is wrong with it
        if options.picture is not None:
            write_picture(options.picture, photographs, by_split(photographs))
    _say_picture(_print(photographs.name, describe_photographs(photographs)), options)
    return 0


def _say_picture(console: Console, options: Options) -> None:
    if options.picture is not None:
        console.print(f"\nwrote {options.picture}", soft_wrap=True)


def _print(name: str, described: dict[str, str]) -> Console:
    console, table = Console(highlight=False), Table.grid(padding=(0, 3, 0, 0))
    for what, text in described.items():
        table.add_row(f"[bold]{what}[/]", text)
    console.print(f"[bold cyan]{name}[/]")
    console.print(table)
    return console


def describe_photographs(photographs: Photographs) -> dict[str, str]:
    """What there is, in words; opens nothing but the first depth image."""
    sizes = Counter(map(tuple, photographs.sizes.tolist()))
    degrees = np.degrees(2 * np.arctan(photographs.sizes[:, 0] / (2 * photographs.Ks[:, 0, 0])))
    extent = extent_of(photographs.viewmats)
    focus = ", ".join(f"{value:.2f}" for value in extent.focus)
    times, splits, cloud = photographs.times, photographs.splits, photographs.cloud
    return {
        "photographs": f"{photographs.num}: {photographs.names[0]} to {photographs.names[-1]}",
        "size": ", ".join(
            f"{width} x {height}" + (f" ({n})" if len(sizes) > 1 else "")
            for (width, height), n in sizes.most_common(4)
        )
        + (", ..." if len(sizes) > 4 else ""),
        "view": f"{degrees.min():.0f}° wide" + (f" to {degrees.max():.0f}°" if np.ptp(degrees) >= 1 else ""),
        "cameras": f"within {extent.radius:.2f} of their middle, looking at ({focus})",
        "splits": "none"
        if splits is None
        else ", ".join(f"{n} {name}" for name, n in Counter(splits).items()),
        "points": "none" if cloud is None else f"{len(cloud.points):,}",
        "depth": "none" if photographs.load_depth is None else _depth_range(photographs),
        "masks": "none" if photographs.load_mask is None else "yes",
        "times": "none" if times is None else f"{times.min():.3f} to {times.max():.3f} s",
    }


def _depth_range(photographs: Photographs) -> str:
    depth = photographs.depth(0)
    if depth is None or not (depth > 0).any():
        return "some, none in the first"
    low, high = np.percentile(depth[depth > 0], [1, 99])
    return f"{low:.2f} to {high:.2f} in the first"


def first_masks(sequence: Sequence) -> dict[int, np.ndarray]:
    """The first mask of each camera that has one, by camera id. One is enough, so files may be missing."""
    masks = {}
    for c, camera in enumerate(sequence.camera_ids):
        with suppress(MissingFile):
            masks[camera] = sequence.mask(0, c)
    return {camera: mask for camera, mask in masks.items() if mask is not None}


def describe_sequence(sequence: Sequence, masks: dict[int, np.ndarray]) -> dict[str, str]:
    """What there is, in words; opens the first depth images."""
    return {
        "cameras": f"{_listed(sequence.camera_ids)}{_movement(sequence)}",
        "image": f"{sequence.width} x {sequence.height}, {_fields_of_view(sequence)}",
        "frames": f"{sequence.num_frames}, numbered {sequence.frame_ids[0]} to {sequence.frame_ids[-1]}",
        "times": _times(sequence),
        "depth": _depth(sequence),
        "masks": _masks(masks, sequence),
        "flow": "yes" if sequence.has_flow else "none",
        "truth": _truth(sequence),
        "shapes": ", ".join(f"{m.name} ({len(m.means):,} Gaussians)" for m in sequence.models) or "none",
    }


def _listed(ids: tuple[int, ...]) -> str:
    return f"{len(ids)}: {', '.join(map(str, ids))}"


def _movement(sequence: Sequence) -> str:
    moving = np.ptp(sequence.viewmats, axis=0).max(axis=(1, 2)) > 1e-6
    if not moving.any():
        return " (fixed)"
    return " (moving)" if moving.all() else f" ({moving.sum()} of them moving)"


def _fields_of_view(sequence: Sequence) -> str:
    degrees = np.degrees(2 * np.arctan(sequence.width / (2 * sequence.Ks[0, :, 0, 0])))
    low, high = degrees.min(), degrees.max()
    return f"{low:.0f}° wide" if high - low < 1 else f"{low:.0f}° to {high:.0f}° wide"


def _times(sequence: Sequence) -> str:
    first, last = sequence.times[0], sequence.times[-1]
    if sequence.num_frames == 1:
        return f"at {first:.3f} s"
    steps = np.diff(sequence.times)
    return f"{last - first:.2f} s, every {1e3 * np.median(steps):.1f} ms ({1 / np.median(steps):.1f} Hz)"


def _depth(sequence: Sequence) -> str:
    known = {}
    for c, camera in enumerate(sequence.camera_ids):
        depth = sequence.depth(0, c)
        if depth is not None:
            known[camera] = depth
    if not known:
        return "none"
    values = np.concatenate([depth[depth > 0] for depth in known.values()])
    whose = "all cameras" if len(known) == sequence.num_cameras else f"cameras {', '.join(map(str, known))}"
    if not len(values):
        return f"{whose}, but no pixel of the first frame is valid"
    low, high = np.percentile(values, [1, 99])
    return f"{whose}, {low:.2f} to {high:.2f} m in the first frame"


def _masks(masks: dict[int, np.ndarray], sequence: Sequence) -> str:
    if not masks:
        return "none"
    whose = "all cameras" if len(masks) == sequence.num_cameras else _named(list(masks))
    labels = sorted({int(value) for mask in masks.values() for value in np.unique(mask)} - {0})
    return f"{whose}, labels {', '.join(map(str, labels)) or 'none but the background'} in the first frame"


def _named(cameras: list[int]) -> str:
    return f"camera{'s' if len(cameras) > 1 else ''} {', '.join(map(str, cameras))}"


def mask_table(masks: dict[int, np.ndarray], sequence: Sequence) -> Table | None:
    """Pixels of each label in the first masks, a row a camera; None where there is nothing to compare."""
    labels = sorted({int(value) for mask in masks.values() for value in np.unique(mask)} - {0})
    if not labels or len(labels) > MOST_LABELS:
        return None
    names = sequence.names_of_labels
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), title_justify="left", title_style="bold")
    table.add_column("first masks")
    for label in labels:
        table.add_column(f"{label} {names.get(label, '')}".strip(), justify="right")
    for camera, mask in list(masks.items())[:MOST_CAMERAS]:
        pixels = [f"{int((mask == label).sum()):,} px" for label in labels]
        table.add_row(f"camera {camera}", *pixels)
    return table


def _truth(sequence: Sequence) -> str:
    truth = sequence.truth
    if truth is None:
        return "none"
    named = [f"{name} (label {label})" for name, label in zip(truth.names, truth.label_ids, strict=True)]
    robot = [] if truth.robot is None else [f"robot (label {truth.robot})"]
    known = ["poses of " + ", ".join(named)] if named else []
    known += [", ".join(robot)] if robot else []
    known += [] if truth.tracks is None else [f"tracks of {truth.tracks.shape[1]:,} points"]
    return "; ".join(known)
