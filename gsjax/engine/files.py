"""Reading back the files of a run, whichever command made it: arrays, the scene, the recording. `again` is
the advice that error messages give if a file has unexpected contents."""

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from gsjax.data import ReadOptions
from gsjax.data.errors import DataError, DataWarning
from gsjax.data.origin import relative_to_origin
from gsjax.engine.recording import Opener, Recording, open_recording
from gsjax.io.arrays import ArraysError, load_arrays
from gsjax.io.brief import brief, shortened
from gsjax.io.parsed import parse_yaml
from gsjax.io.ply import write_ply
from gsjax.io.scene_file import SceneReport
from gsjax.io.scenes import read_gaussians
from gsjax.io.sequences import missing_numbers
from gsjax.scene.gaussians import Gaussians

_SETTINGS = ("dataset", "cameras", "frames")


def read_arrays(file: Path, wanted: Sequence[str], again: str) -> dict[str, np.ndarray]:
    """The arrays of a .npz file.

    Args:
        file: a .npz.
        wanted: names of arrays that must be there.
        again: what to do if one is missing, for the error.

    Raises:
        ValueError: it cannot be read, or lacks one of them.
    """
    try:
        arrays = load_arrays(file)
    except ArraysError as error:
        raise ValueError(
            f"{file}: expected plain arrays, found a file that cannot be read; {again}"
        ) from error
    _expect_arrays(file, arrays, wanted, again)
    return arrays


def _expect_arrays(file: Path, arrays: Mapping[str, np.ndarray], wanted: Iterable[str], again: str) -> None:
    missing = [name for name in wanted if name not in arrays]
    if missing:
        found = brief(", ".join(arrays)) or "an array without a name"  # as in an .npy file
        raise ValueError(f"{file}: expected an array {missing[0]}, found {found}; {again}")


def check_arrays(
    file: Path, arrays: Mapping[str, np.ndarray], shapes: Mapping[str, Sequence[str | int]], again: str
) -> dict[str, int]:
    """Check that arrays of a file are there, hold finite numbers and have matching shapes.

    Args:
        file: their file, for the error.
        arrays: the arrays by name.
        shapes: shape of each array to check. A letter stands for the same size throughout, at least 1.
        again: what to do if one is wrong, for the error.

    Returns:
        The size of each letter.

    Raises:
        ValueError: an array is missing, has another shape, holds no numbers, or is not finite everywhere.
    """
    _expect_arrays(file, arrays, shapes, again)
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        array = arrays[name]
        if array.dtype.kind not in "iuf":
            raise ValueError(f"{file}: {name}: expected numbers, found {array.dtype}; {again}")
        known = [sizes.get(n, n) if isinstance(n, str) else n for n in shape]
        fits = len(known) == array.ndim and all(
            size > 0 if isinstance(n, str) else size == n for n, size in zip(known, array.shape, strict=True)
        )
        if not fits:
            wanted, found = (",".join(map(str, each)) for each in (known, array.shape))
            raise ValueError(f"{file}: {name}: expected the shape [{wanted}], found [{found}]; {again}")
        sizes |= {n: found for n, found in zip(shape, array.shape, strict=True) if isinstance(n, str)}
        with np.errstate(over="ignore"):  # as they will be used
            wrong = int((~np.isfinite(array.astype(np.float32))).sum())
        if wrong:
            found = f"{wrong} of {array.size} that are not, as float32"
            raise ValueError(f"{file}: {name}: expected finite numbers, found {found}; {again}")
    return sizes


def write_scene(
    path: Path,
    gaussians: Gaussians,
    labels: Int[np.ndarray, "n"] | None = None,
    *,
    origin: Float[np.ndarray, "3"] | None = None,
    antialiased: bool = False,
) -> None:
    """Write Gaussians, without their features, as a PLY that any 3DGS viewer reads.

    Args:
        path: the file.
        gaussians: the Gaussians.
        labels: their labels, written to a file beside it.
        origin, antialiased: as for `write_ply`.
    """
    if gaussians.features is not None:
        gaussians = eqx.tree_at(lambda g: g.features, gaussians, None)
    write_ply(path, gaussians, labels=labels, origin=origin, antialiased=antialiased)


def read_drawable(file: Path) -> tuple[Gaussians, SceneReport]:
    """The drawable Gaussians of a file, and what else it held.

    Raises:
        FileNotFoundError, SceneError: as for `read_gaussians`.
        ValueError: it holds none.
    """
    gaussians, report = read_gaussians(file)
    if gaussians.num == 0:
        raise ValueError(f"{file}: expected Gaussians, found none that can be drawn")
    return gaussians, report


def read_frames(files: Sequence[Path]) -> Iterator[tuple[Gaussians, SceneReport]]:
    """Yields the Gaussians of each file of a moving scene, and what else it held. The warning about an origin
    is given for the first file only.

    Args:
        files: the files of its frames, in order.

    Raises:
        FileNotFoundError, SceneError: as for `read_gaussians`.
        ValueError: a file holds none, or not as many Gaussians or harmonics as the first.
    """
    if missing := missing_numbers(files):
        some = shortened(map(str, missing), 5)
        message = f"{files[0].parent}: no frame {some} among {len(files)}; add it, or renumber the others"
        warnings.warn(message, DataWarning, stacklevel=2)
    first = None
    for file in files:
        with warnings.catch_warnings():
            if first is not None:
                warnings.filterwarnings("ignore", ".*relative to the origin")
            gaussians, report = read_drawable(file)
        first = first or gaussians
        if gaussians.num != first.num and gaussians.num < report.stored:
            found = f"{report.stored - gaussians.num} that cannot, of {report.stored}"
            raise ValueError(
                f"{file}: expected {first.num} Gaussians that can be drawn, as in {files[0].name}, found "
                f"{found}; leave these out of every frame"
            )
        if (gaussians.num, gaussians.sh_degree) != (first.num, first.sh_degree):
            raise ValueError(
                f"{file}: expected {first.num} Gaussians of degree {first.sh_degree} as in {files[0].name}, "
                f"found {gaussians.num} of degree {gaussians.sh_degree}; a scene that moves has the same in "
                "every frame, so give one file, or put files of other scenes elsewhere"
            )
        yield gaussians, report


def read_scene(
    path: Path, count: int, arrays: str, again: str
) -> tuple[Gaussians, Float[np.ndarray, "3"] | None]:
    """The Gaussians of a run's scene.ply, and the origin that they are relative to, if they are far from 0.

    Args:
        path: folder of the run.
        count: the expected number.
        arrays: the name of the file with that number.
        again: what to do if they differ, for the error.

    Raises:
        ValueError: there are not as many, or not all of them can be drawn.
    """
    gaussians, report = read_gaussians(path / "scene.ply")
    if gaussians.num != count or report.stored != count:
        found = f"{gaussians.num} drawable Gaussians of {report.stored} in scene.ply"
        raise ValueError(f"{path}: expected {count} Gaussians as in {arrays}, found {found}; {again}")
    return gaussians, report.origin


def relative_to_scene(recording: Recording, origin: Float[np.ndarray, "3"] | None) -> Recording:
    """The recording with coordinates relative to the origin of its scene."""
    tracked, judged = (relative_to_origin(each, origin) for each in (recording.tracked, recording.judged))
    return replace(recording, tracked=tracked, judged=judged)


def reopen(
    config: Path,
    again: str,
    also: Callable[[Mapping[str, Any]], Any] = lambda settings: None,
    opened: Opener | None = None,
) -> tuple[Recording, Any]:
    """The recording of a run, opened as its config.yml says, and something else from its settings.

    Args:
        config: the file.
        again: what to do if it cannot be used, for the error.
        also: settings -> what else to return.
        opened: opens the dataset, as the run's command does (default: `open_sequence`).

    Raises:
        ValueError: the settings are not those of a run, or the recording cannot be opened.
    """
    try:
        settings = parse_yaml(config.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{config}: expected a run's settings, found others ({error}); {again}") from error
    try:
        wanted = also(settings)
        read = read_options(settings.get("read") or {})
        scale = settings.get("scale", 1.0)
        if not isinstance(scale, int | float):
            raise TypeError(f"scale: {scale!r}")
        dataset, cameras, frames = (settings[name] for name in _SETTINGS)
        held_out = settings.get("eval_cameras") or ()  # not all commands have this option
        return open_recording(dataset, cameras, held_out, frames, read, float(scale), opened), wanted
    except (KeyError, TypeError, AttributeError) as error:
        listed = ", ".join(_SETTINGS)
        raise ValueError(f"{config}: expected a run's settings ({listed}), found others; {again}") from error
    except DataError as error:
        raise ValueError(
            f"{config}: its recording cannot be opened: {error} A path that is not absolute is relative to "
            "the working directory."
        ) from error


def read_options(stored: Mapping[str, Any]) -> ReadOptions:
    """The options by which a dataset was read, from a config.yml; unknown ones are left out."""
    known = {field.name for field in fields(ReadOptions)}
    plain = {name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()}
    return ReadOptions(**{name: value for name, value in plain.items() if name in known})


def chosen_camera(recording: Recording, camera: int | None, run: Path) -> int:
    """The id of a camera of a run; default: the first held-out one, else the first.

    Raises:
        ValueError: the run had no such camera.
    """
    known = list(recording.judged.camera_ids)
    if camera is None:
        return [*recording.held_out, *known][0]
    if camera not in known:
        raise ValueError(f"--camera: {run} has no camera {camera}; it has {known}.")
    return camera
