"""Which photographs a static scene is fitted to and judged by: chosen, split, and read."""

import warnings
from collections.abc import Mapping
from collections.abc import Sequence as Indices
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int
from rich.console import Console
from rich.progress import track

from gsjax.data.errors import DataWarning
from gsjax.data.open import ReadOptions, is_photographs, is_recording, open_photographs
from gsjax.data.photographs import Photographs, photographs_of
from gsjax.engine.files import read_options
from gsjax.engine.folder import expect_dataset
from gsjax.engine.machine import available_mb
from gsjax.engine.recording import expect_enough_left, open_recording, parse_frames
from gsjax.scene.frame import Frame

_LARGE = 1600  # pixels, a side
_BYTES_A_PIXEL = 8  # a photograph, as it is and on the device, and a mask


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
        read: what its layout leaves open.
        scale: how much smaller they shall be.
        frames: which ones, or which frames of a recording, as Python slices them.
        cameras: ids of those of a recording; all, unless given.
        eval_cameras: ids of those whose frames are the split "test"; then all others are "train".

    Raises:
        DataError: the dataset cannot be read.
        ValueError: none is chosen, a camera is not there, or photographs are asked for by camera; it is the
            folder of a run.
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
                f"--frames: {frames} holds no photograph of {photographs.name}, which has 0 to "
                f"{photographs.num - 1}."
            )
        return smaller(photographs.select(chosen), scale)
    recording = open_recording(dataset, cameras, eval_cameras, frames, read)
    photographs = photographs_of(recording.judged)
    if eval_cameras:
        places = np.arange(photographs.num) % recording.judged.num_cameras
        held_out = places >= recording.tracked.num_cameras
        photographs = replace(photographs, splits=tuple("test" if out else "train" for out in held_out))
    return smaller(photographs, scale)


def smaller(photographs: Photographs, scale: float) -> Photographs:
    """The same views in smaller photographs.

    Raises:
        ValueError: `scale` is not above 0 and at most 1, or leaves next to nothing of one.
    """
    scaled = photographs.scaled(scale)
    least = scaled.sizes.min(1).argmin()
    sizes = (tuple(of.sizes[least].tolist()) for of in (photographs, scaled))
    expect_enough_left(scale, "a photograph", *sizes)
    return scaled


def photographs_of_run(settings: Mapping[str, Any], dataset: str | None = None) -> Photographs:
    """Those of a fit, by what stands in its config.yml.

    Args:
        settings: what stands there.
        dataset: where they are now; where they were, unless given.

    Raises:
        DataError: they cannot be read.
        KeyError, TypeError, ValueError: the settings are not those of a fit.
    """
    more = {name: settings[name] for name in ("frames", "cameras", "eval_cameras") if name in settings}
    return choose_photographs(
        dataset or str(settings["dataset"]),
        read_options(settings.get("read") or {}),
        scale=float(settings.get("scale", 1.0)),
        **more,
    )


def split(photographs: Photographs, every: int) -> tuple[Int[np.ndarray, "a"], Int[np.ndarray, "b"]]:
    """Which photographs are fitted and which are held out: as the data says, else every n-th.

    Raises:
        ValueError: none is left to fit.
    """
    indices = np.arange(photographs.num)
    splits = None if photographs.splits is None else np.array(photographs.splits)
    if splits is not None and (splits != "train").any():
        held_out = np.isin(splits, "test" if (splits == "test").any() else "val")
        chosen = indices[splits == "train"]
    else:
        held_out = (indices % every == 0) & (photographs.num > 1) if every else np.zeros(len(indices), bool)
        chosen = indices[~held_out]
    if not len(chosen):
        raise ValueError(f"{photographs.name}: of {photographs.num} photographs none is left to fit")
    return chosen, indices[held_out]


def read_frames(photographs: Photographs, console: Console) -> list[Frame]:
    """All photographs in memory, each as a frame of one camera.

    Raises:
        DataError: one is bad.
        ValueError: they are too many for this machine's memory.
    """
    wanted, free = photographs.sizes.prod(1).sum() * _BYTES_A_PIXEL / 1e6, available_mb()
    if wanted > free:
        raise ValueError(
            f"{photographs.name}: {photographs.num} photographs need some {wanted / 1e3:.1f} GB, and "
            f"{free / 1e3:.1f} GB are free; try --scale, or fewer --frames"
        )

    with ThreadPoolExecutor(2) as executor:
        jobs = [executor.submit(photographs.frame, i) for i in range(photographs.num)]
        try:
            shown = track(jobs, "reading photographs", console=console, transient=True)
            return [job.result() for job in shown]
        except BaseException:
            executor.shutdown(cancel_futures=True)
            raise


def say_if_large(photographs: Photographs) -> None:
    """A DataWarning where photographs are larger than a fit on a CPU has time for."""
    width, height = photographs.sizes.max(0)
    if max(width, height) > _LARGE:
        scale = 2.0 ** np.floor(np.log2(_LARGE / max(width, height)))
        message = f"photographs of {width}x{height} take long and need much memory; try --scale {scale:g}"
        warnings.warn(message, DataWarning, stacklevel=2)
