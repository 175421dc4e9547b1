"""Saving and reopening results. `gsjax.save` and `gsjax.load` store a tick of any method in one file and read
it back without a template; `gsjax.open_scene` and `gsjax.open_field` open what commands wrote, and
`gsjax.write_field` writes a field as `gsjax distill` does."""

import dataclasses
import json
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from gsjax.engine.drive import Tick
from gsjax.io.atomic import write_npz
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from gsjax.scene.feature_grid import FeatureGrid

if TYPE_CHECKING:
    from gsjax.methods.distill import DistillResult
    from gsjax.viz.viewer import Viewable
else:
    DistillResult = Any
    Viewable = Any  # slow to import, like everything that shows a scene

FIELD_FORMAT = 1
"""Format of field.npz."""
_UNKNOWN_SOURCE = {"kind": "files", "names": {}, "weights": None}


def save(path: str | os.PathLike, now: Tick) -> None:
    """Write the state of a method, its configuration and its result to a file, atomically.

    Args:
        path: the file; `.npz` by convention.
        now: the newest tick: the arrays of earlier ones have been donated. Custom losses are functions and
            are not stored; pass them again to continue.
    """
    method = now.method
    if getattr(method, "extra_losses", ()):
        method = dataclasses.replace(method, extra_losses=())
    stored = {"method": method, "run": now.run, "result": now.result, "info": now.info}
    times = {name: getattr(now, name) for name in ("seconds", "compile_seconds", "progress")}
    save_checkpoint(path, stored, times)


def load(path: str | os.PathLike) -> Tick:
    """The tick that `save` wrote. Its `result` is available at once; to continue, pass it to the verb that
    made it: `gsjax.fit(photographs, now.method.config, after=now)`.

    Raises:
        FileNotFoundError: there is no file at `path`.
        IsADirectoryError: it is a folder, such as that of a run of the command line.
        CheckpointError: it is damaged, of another version of gsjax, or holds something else.
    """
    if os.path.isdir(path):
        raise IsADirectoryError(
            f"{os.fspath(path)}: expected a file of gsjax.save, found a folder; gsjax.open_scene opens the "
            "scene of a run"
        )
    stored, times = load_checkpoint(path)
    if not isinstance(stored, dict) or set(stored) != {"method", "run", "result", "info"}:
        raise CheckpointError(
            f"{path}: expected what gsjax.save writes, found another checkpoint; to continue from the resume "
            "folder of a run, use --resume"
        )
    result: Any = stored.pop("result")
    now = Tick(problem=None, **stored, **times)
    vars(now)["result"] = result
    return now


def open_scene(path: str | os.PathLike) -> Viewable:
    """The scene, over time, of a run of the command line, of a file of Gaussians, or of a folder of numbered
    files. `scene.at(frame)` is one frame, for `gsjax.render`, relative to `scene.origin` if the data lie far
    from 0; `scene.num_frames` is the number of frames, and `scene.labels` has the label of each Gaussian.
    Problems that do not prevent opening it are issued as warnings.

    Args:
        path: the folder of a run, the file, or the folder of files.

    Raises:
        FileNotFoundError: there is nothing at `path`, or no scene.
        ValueError: a file has unexpected contents, or holds no Gaussians.
    """
    from rich.console import Console

    from gsjax.engine.messages import Notes
    from gsjax.engine.viewables import open_viewable

    notes = Notes(Console(quiet=True))
    scene, _ = open_viewable(Path(path), notes)
    for text in notes.warnings:
        warnings.warn(text, UserWarning, stacklevel=2)
    return scene


def open_field(path: str | os.PathLike, scene: str | os.PathLike | None = None) -> DistillResult:
    """The field that `gsjax distill` made, with the Gaussians of its scene. Problems that do not prevent
    opening it are issued as warnings.

    Args:
        path: the field's folder, or that of the run that contains it.
        scene: current path of the scene's file, if it was moved.

    Raises:
        FileNotFoundError: there is no field, or its scene is missing.
        ValueError: a file has unexpected contents, or the field does not fit the scene.
    """
    from rich.console import Console

    from gsjax.engine.distill.saved import Locations, field_of, open_field_run
    from gsjax.engine.messages import Notes

    folder = field_of(Path(path))
    if folder is None:
        raise FileNotFoundError(f"{path}: expected a field (field.npz), found none; gsjax distill makes one")
    notes, now = Notes(Console(quiet=True)), Locations(None if scene is None else Path(scene))
    found = open_field_run(folder, notes, now, photographs=False).stored
    for text in notes.warnings:
        warnings.warn(text, UserWarning, stacklevel=2)
    return found


def write_field(path: str | os.PathLike, result: DistillResult) -> None:
    """Write field.npz, which `gsjax query` and `gsjax view` read beside the scene. An existing file is
    replaced only once the new one is complete.

    Raises:
        OSError: the file cannot be written.
    """
    encoding = result.field.encoding
    source = _UNKNOWN_SOURCE if result.source is None else result.source.plain()
    about: dict[str, Any] = {"format": FIELD_FORMAT, "source": source, "scene": dict(result.scene)}
    arrays = {"lift": result.field.lift}
    if isinstance(encoding, FeatureGrid):
        assert result.rows is not None
        about["grid"] = dataclasses.asdict(encoding.config)
        arrays |= {"rows": result.rows, "table": encoding.table, "bounds": np.array(encoding.bounds)}
        for i, layer in enumerate(encoding.layers):
            assert layer.bias is not None
            arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    else:
        arrays["vectors"] = encoding
    write_npz(path, {**arrays, "about": json.dumps(about)})
