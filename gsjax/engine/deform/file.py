"""deformation.npz: a deforming scene in a file that does not need the recording it was learned from."""

import os
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from gsjax.data.files import as_numbers
from gsjax.engine.messages import Notes
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, load_metadata, save_checkpoint
from gsjax.io.parsed import parse_json
from gsjax.methods.deform import DeformResult, Moving
from gsjax.scene.deformation import Nodes

_AGAIN = "reconstruct it again with this version of gsjax"


def write_deformation(
    path: str | os.PathLike,
    result: DeformResult,
    origin: Float[np.ndarray, "3"] | None = None,
    background: tuple[float, float, float] | None = None,
) -> None:
    """Write a deforming scene to `path` atomically, as a checkpoint (`gsjax.io.checkpoints`).

    Args:
        path: the file; its suffix is `.npz` by convention.
        result: the scene.
        origin: what it is relative to, if the recording lies far from 0; stored as metadata.
        background: RGB, 0 to 1, behind the scene, if it was learned with one; stored as metadata.
    """
    beside = {"origin": None if origin is None else origin.tolist(), "background": background}
    save_checkpoint(path, result, {name: value for name, value in beside.items() if value is not None})


class Metadata(NamedTuple):
    """The metadata that `write_deformation` stores with a scene.

    Attributes:
        origin: what the scene is relative to; None for 0.
        background: RGB, 0 to 1, behind the scene; None for black.
    """

    origin: Float[np.ndarray, "3"] | None
    background: tuple[float, ...] | None


def read_metadata(path: str | os.PathLike) -> Metadata:
    """The metadata of a scene that `write_deformation` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged.
    """
    stored = load_metadata(path)
    found = {name: stored.get(name) for name in Metadata._fields}
    origin, background = (
        None if value is None else as_numbers(Path(path), name, value, (3,)) for name, value in found.items()
    )
    return Metadata(origin, None if background is None else tuple(background.tolist()))


def read_deformation(path: str | os.PathLike) -> DeformResult:
    """The scene that `write_deformation` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is damaged, of another version of gsjax, or holds something else; or numbers in it are
            not finite or inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a scene that `gsjax deform` wrote, found no file")
    try:
        result, _ = load_checkpoint(path)
    except CheckpointError as error:
        raise ValueError(f"{error}; or {_AGAIN}") from error
    if not isinstance(result, DeformResult):
        raise ValueError(
            f"{path}: expected what `gsjax deform` writes, found a checkpoint of something else; {_AGAIN}"
        )
    try:
        wrong = _misfit(result)
    except (TypeError, ValueError, AttributeError, IndexError) as error:  # parts of other types
        wrong = f"expected the parts of a deforming scene, found others ({error})"
    if wrong is not None:
        raise ValueError(f"{path}: {wrong}; {_AGAIN}")
    return result


def warn_of_partial(path: Path, notes: Notes) -> None:
    """Warns if the run in a folder was stopped before its end."""
    try:
        found = parse_json((path / "metrics.json").read_text(encoding="utf-8"))
        steps = found["steps"] if not found["complete"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return
    if steps is not None:
        notes.warn(f"{path} is a partial run of {steps} steps; continue it with gsjax deform --resume")


def _misfit(result: DeformResult) -> str | None:
    """The first inconsistency of a result, in words; None if there is none."""
    gaussians, timeline, meaning = result.scene.gaussians, result.timeline, result.meaning
    frames = len(timeline.times)
    if not frames or not frames == len(timeline.frame_ids) == len(timeline.viewmats) == len(timeline.Ks):
        return "expected a time, a number and a camera for each frame"
    if min(timeline.size) < 1 or not set(timeline.held_out.tolist()) <= set(range(frames)):
        return "expected a size of pictures, and held-out frames of these"
    if meaning is not None:
        channels = None if gaussians.features is None else gaussians.features.shape[1]
        if meaning.codebook.shape != (len(meaning.names), channels) or meaning.basis.shape[1:] != (channels,):
            return "expected a code for each name, in as many channels as features have"
    vectors = () if meaning is None else (meaning.codebook, meaning.basis)
    cameras = (timeline.times, timeline.viewmats, timeline.Ks, np.array([timeline.seconds, timeline.near]))
    numbers = (result.scene, result.moving, vectors, cameras)
    for leaf in jax.tree.leaves(eqx.filter(numbers, eqx.is_inexact_array)):
        if not np.isfinite(np.asarray(leaf)).all():
            return "expected finite numbers, found others"
    return _misfit_of_moving(result.moving, gaussians.num)


def _misfit_of_moving(moving: Moving, count: int) -> str | None:
    """The first inconsistency of the rows or nodes where the field is evaluated, for `count` Gaussians."""
    if moving is None:
        return None
    bounded = {"rows": (moving.rows if isinstance(moving, Nodes) else moving, count)}
    if isinstance(moving, Nodes):
        bounded["indices"] = (moving.indices, len(moving.rows))
    for name, (array, most) in bounded.items():
        if array.min() < 0 or array.max() >= most:
            return f"{name}: expected 0 to {most - 1}, found others"
    return None
