"""The photographs that a static scene is fitted to and evaluated on: selected, split, and read."""

from collections.abc import Mapping
from collections.abc import Sequence as Indices
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.console import Console

from gsjax.data.consistency import check_photographs, check_recording
from gsjax.data.errors import DataError
from gsjax.data.open import ReadOptions, is_photographs, is_recording, open_photographs
from gsjax.data.photographs import Photographs, photographs_of
from gsjax.engine.files import read_options
from gsjax.engine.folder import expect_dataset
from gsjax.engine.machine import available_mb
from gsjax.engine.recording import expect_enough_left, in_threads, open_recording, parse_frames
from gsjax.scene.frame import Frame

_LARGE = 1600  # pixels, a side, as in 3DGS
_BYTES_A_PIXEL = 8  # a photograph on the host and on the device, and a mask


def choose_photographs(
    dataset: str,
    read: ReadOptions | None = None,
    *,
    scale: float = 1.0,
    frames: str = ":",
    cameras: Indices[int] = (),
    eval_cameras: Indices[int] = (),
) -> Photographs:
    """The photographs of a dataset, or the frames of a recording as photographs.

    Args:
        dataset: a folder, or a built-in scene.
        read: details that its layout leaves open.
        scale: their size relative to the original.
        frames: the photographs, or the frames of a recording, as a Python slice.
        cameras: ids of the cameras of a recording; if empty, all.
        eval_cameras: ids of the cameras whose frames are the split "test"; then all others are "train".

    Raises:
        DataError: the dataset cannot be read.
        ValueError: none is selected, a camera does not exist, photographs are selected by camera, or the
            dataset is the folder of a run.
    """
    expect_dataset(dataset)
    if is_photographs(dataset) or not is_recording(dataset):
        photographs = open_photographs(dataset, read)
        for option, ids in (("--cameras", cameras), ("--eval-cameras", eval_cameras)):
            if ids:
                raise ValueError(
                    f"{option}: {dataset} holds photographs, not a recording by numbered cameras; leave it "
                    "out (--frames chooses among photographs)"
                )
        chosen = range(photographs.num)[parse_frames(frames)]
        if not chosen:
            raise ValueError(
                f"--frames: {frames} selects no photograph of {photographs.name}, which has 0 to "
                f"{photographs.num - 1}."
            )
        photographs = photographs.select(chosen)
        check_photographs(photographs)
        return smaller(photographs, scale)
    recording = open_recording(dataset, cameras, eval_cameras, frames, read)
    check_recording(recording.judged)
    photographs = photographs_of(recording.judged)
    if eval_cameras:
        places = np.arange(photographs.num) % recording.judged.num_cameras
        held_out = places >= recording.tracked.num_cameras
        photographs = replace(photographs, splits=tuple("test" if out else "train" for out in held_out))
    return smaller(photographs, scale)


def smaller(photographs: Photographs, scale: float | None) -> Photographs:
    """The same views in smaller photographs.

    Args:
        photographs: of any sizes.
        scale: of all photographs; None for at most 1,600 pixels a side, as in other 3DGS trainers.

    Raises:
        ValueError: `scale` is not above 0 and at most 1, or makes one too small.
    """
    if scale is None:
        return photographs.scaled(np.minimum(1.0, _LARGE / photographs.sizes.max(1)))
    scaled = photographs.scaled(scale)
    least = scaled.sizes.min(1).argmin()
    sizes = (tuple(of.sizes[least].tolist()) for of in (photographs, scaled))
    expect_enough_left(scale, "a photograph", *sizes)
    return scaled


def photographs_of_run(settings: Mapping[str, Any], dataset: str | None = None) -> Photographs:
    """The photographs of a fit, by the settings of its config.yml; `dataset` is their path if it has changed.

    Raises:
        ValueError: they cannot be read.
        KeyError, TypeError, ValueError: the settings are not those of a fit.
    """
    more = {name: settings[name] for name in ("frames", "cameras", "eval_cameras") if name in settings}
    given = settings.get("scale", 1.0)
    scale = None if given is None else float(given)
    try:
        photographs = choose_photographs(
            dataset or str(settings["dataset"]), read_options(settings.get("read") or {}), **more
        )
        return smaller(photographs, scale)
    except DataError as error:
        raise ValueError(
            f"{error} The fit read its photographs from there; if they were moved, pass their new folder as "
            "--images"
        ) from error


def split(photographs: Photographs, every: int) -> tuple[Int[np.ndarray, "a"], Int[np.ndarray, "b"]]:
    """Indices of the photographs to fit and of those held out: by the data's split, else every n-th.

    Raises:
        ValueError: no photograph is left to fit.
    """
    found = data_split(photographs.splits)
    if found is None:
        indices = np.arange(photographs.num)
        held_out = (indices % every == 0) & (photographs.num > 1) if every else np.zeros(len(indices), bool)
        found = indices[~held_out], indices[held_out]
    if not len(found[0]):
        raise ValueError(
            f"{photographs.name}: expected photographs to fit, found all {photographs.num} held out"
        )
    return found


def data_split(splits: tuple[str, ...] | None) -> tuple[Int[np.ndarray, "a"], Int[np.ndarray, "b"]] | None:
    """Indices of what the data assigns to training and of what it holds out: "test" or, without it, "val".
    None if it holds out nothing.

    Args:
        splits: "train", "val" or "test" for each photograph or frame; None if the data has no splits.
    """
    if splits is None or set(splits) <= {"train"}:
        return None
    named = np.array(splits)
    held_out = "test" if (named == "test").any() else "val"
    return np.flatnonzero(named == "train"), np.flatnonzero(named == held_out)


def read_frames(photographs: Photographs, console: Console) -> list[Frame]:
    """All photographs in memory, each as a frame of one camera.

    Raises:
        DataError: one cannot be read.
        ValueError: they do not fit in this machine's memory.
    """
    wanted, free = photographs.sizes.prod(1).sum() * _BYTES_A_PIXEL / 1e6, available_mb()
    if wanted > free:
        raise ValueError(
            f"{photographs.name}: {photographs.num} photographs need some {wanted / 1e3:.1f} GB, and "
            f"{free / 1e3:.1f} GB are free; try --scale, or fewer --frames"
        )
    return in_threads(photographs.frame, range(photographs.num), "reading photographs", console)
