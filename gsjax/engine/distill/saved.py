"""The folder of `gsjax distill` read back: the field, its scene, and the photographs of the scene."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from gsjax.data.photographs import Photographs
from gsjax.engine.distill.file import FOLDER, NAME, read_field
from gsjax.engine.distill.scene import SceneOptions, open_field_scene
from gsjax.engine.files import read_drawable, read_options
from gsjax.engine.folder import is_run
from gsjax.engine.messages import Notes, describe
from gsjax.engine.records import digest
from gsjax.io.scene_file import SceneReport
from gsjax.io.scenes import is_scene
from gsjax.methods.distill import DistillResult
from gsjax.methods.protocols import LanguageEncoder
from gsjax.scene.gaussians import Gaussians

_OF_IMAGES = ("images", "scale", "frames", "cameras", "eval_cameras", "test_every")


@dataclass(frozen=True)
class Locations:
    """Current locations of a field's scene, photographs and encoder (default: where they were).

    Attributes:
        scene: the scene's file.
        images: the photographs.
        weights: folder of CLIP's weights.
    """

    scene: Path | None = None
    images: str | None = None
    weights: Path | None = None


UNMOVED = Locations()


@dataclass(frozen=True, eq=False)
class FieldRun:
    """A field and its scene.

    Attributes:
        path: folder of the field.
        stored: the field, with the means of the scene's Gaussians.
        file: the scene's file.
        gaussians: the scene.
        rows: row of the file of each Gaussian.
        num_rows: number of rows in the file, including Gaussians that cannot be drawn.
        labels: label of each Gaussian, if the file has them.
        origin: what positions are relative to, if those of the file lie far from 0.
        photographs: of the scene; None if they are no longer there.
        weights: folder of CLIP's weights (default: where they were).
    """

    path: Path
    stored: DistillResult
    file: Path
    gaussians: Gaussians
    rows: Int[np.ndarray, "n"]
    num_rows: int
    labels: Int[np.ndarray, "n"] | None
    origin: Float[np.ndarray, "3"] | None
    photographs: Photographs | None
    weights: Path | None = None

    @property
    def rasterize_mode(self) -> str:
        """How the scene was fitted and is drawn: "classic" or "antialiased"."""
        return str(self.stored.scene.get("rasterize_mode", "classic"))

    @property
    def unit(self) -> str:
        """Unit of lengths: metres with a depth sensor, else unknown."""
        return "m" if self.photographs is not None and self.photographs.load_depth is not None else ""

    @cached_property
    def encoder(self) -> LanguageEncoder:
        """The encoder that reads texts in the space of the field's features.

        Raises:
            ValueError, FileNotFoundError: as for `Source.encoder`.
        """
        return self.stored.source.encoder(self.weights)


def field_of(path: Path) -> Path | None:
    """The folder of the field: `path` itself, or the one inside the run at `path`; None if there is none."""
    return next((folder for folder in (path, path / FOLDER) if (folder / NAME).is_file()), None)


def open_field_run(
    folder: Path, notes: Notes, now: Locations = UNMOVED, *, photographs: bool = True
) -> FieldRun:
    """Read a field and its scene.

    Args:
        folder: the folder that holds field.npz.
        notes: receives warnings.
        now: where the scene, photographs and weights are now, if they were moved.
        photographs: whether to open the photographs too.

    Raises:
        FileNotFoundError: a file of the field, or the scene, is missing.
        ValueError: a file has other contents, the field does not fit the scene, or photographs named in
            `now` cannot be read.
    """
    stored = read_field(folder / NAME)
    file = _scene_file(folder, stored, now.scene, notes)
    gaussians, report = read_drawable(file)
    if stored.rows is None and len(stored.field.encoding) != gaussians.num:
        raise ValueError(
            f"{folder}: expected a scene with the field's {len(stored.field.encoding)} Gaussians, found "
            f"{gaussians.num} in {file}; give another with --scene, or distil the field again"
        )
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    stored = replace(stored, means=gaussians.means)
    read = gaussians, report
    shown = _photographs(folder, stored, file, read, now.images, notes) if photographs else None
    of_file = (report.rows, report.stored, report.labels, report.origin)
    return FieldRun(folder, stored, file, gaussians, *of_file, shown, now.weights)


def _scene_file(folder: Path, stored: DistillResult, given: Path | None, notes: Notes) -> Path:
    """The file of a field's scene, recognised by its content if it was moved."""
    was, parent = Path(stored.scene.get("file") or folder / "scene.ply"), folder.absolute().parent
    beside = (parent / "scene.ply", parent / "canonical" / "scene.ply", folder / "scene.ply")
    there = [file for file in (was, *beside) if file.is_file()] if given is None else [given]
    if not there or not there[0].is_file():
        raise FileNotFoundError(
            f"{given or was}: expected the scene of {folder}, found no file; give it with --scene"
        )
    sha256 = stored.scene.get("sha256")  # None for a field that was distilled in Python
    fitting = (file for file in there if sha256 in (None, digest(file)))
    if (file := next(fitting, None)) is not None:
        return file
    notes.warn(
        f"{there[0]} has changed since the field in {folder} was distilled; answers may be wrong "
        "(give another with --scene)"
    )
    return there[0]


def _photographs(
    folder: Path,
    stored: DistillResult,
    file: Path,
    read: tuple[Gaussians, SceneReport],
    images: str | None,
    notes: Notes,
) -> Photographs | None:
    """The photographs that the field learned from; None, with a warning, if they cannot be read.

    Raises:
        ValueError: they are not where `images` says.
    """
    try:
        try:
            options = _options(stored.scene.get("photographs"), folder, file, images)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{folder / NAME}: expected the training photographs' names, found others ({error}); "
                "distil it again with this version of gsjax"
            ) from error
        return open_field_scene(options, read).photographs
    except (ValueError, OSError) as error:
        if images is not None:
            raise ValueError(f"--images {images}: {describe(error)}") from error
        notes.warn(
            f"its photographs cannot be read, so nothing is drawn: {describe(error)}; pass the folder "
            "that they are in now as --images"
        )
        return None


def _options(settings: Any, folder: Path, file: Path, images: str | None) -> SceneOptions:
    """The options of `gsjax distill` that chose the photographs."""
    chosen = {name: _tuple(settings[name]) for name in _OF_IMAGES}
    if images is not None:
        chosen["images"] = images
    run, parent = Path(settings["scene"]), folder.absolute().parent
    if not is_scene(run) and not run.exists() and folder.name == FOLDER and is_run(parent):
        run = parent  # the run was moved as a whole
    return SceneOptions(run if run.is_dir() else file, read=read_options(settings["read"]), **chosen)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Short names of photographs, usable as file names; for one frame of a recording, its camera names."""
    parts = [name.rsplit("/", 1) for name in names]
    if all(len(part) == 2 for part in parts) and len({part[1] for part in parts}) == 1:
        short = [part[0] for part in parts]
        if len(set(short)) == len(short):
            return tuple(short)
    full = [name.replace("/", "_") for name in names]
    for short in ([str(Path(name).with_suffix("")).replace("/", "_") for name in names], full):
        if len(set(short)) == len(short):
            return tuple(short)
    return tuple(f"{i}_{name}" for i, name in enumerate(full))
