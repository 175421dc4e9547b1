"""The folder of `gsjax distill` read back: the field, its scene, and the photographs of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Int

from gsjax.data.photographs import Photographs
from gsjax.engine.distill.file import FOLDER, NAME, StoredField, read_field
from gsjax.engine.distill.scene import SceneOptions, open_scene
from gsjax.engine.files import read_drawable, read_options
from gsjax.engine.folder import is_run
from gsjax.engine.messages import Notes, describe
from gsjax.engine.records import digest
from gsjax.methods.protocols import LanguageEncoder
from gsjax.scene.gaussians import Gaussians

_OF_IMAGES = ("images", "scale", "frames", "cameras", "eval_cameras", "test_every")


@dataclass(frozen=True)
class Whereabouts:
    """Where that is now which a field goes with; where it was, unless given.

    Attributes:
        scene: a PLY file.
        images: the photographs.
        weights: folder of CLIP's.
    """

    scene: Path | None = None
    images: str | None = None
    weights: Path | None = None


AS_IT_WAS = Whereabouts()


@dataclass(frozen=True, eq=False)
class FieldRun:
    """A field and what it is of.

    Attributes:
        path: its folder.
        stored: the field.
        file: the scene's.
        gaussians: the scene.
        rows: of the file, one for each Gaussian.
        num_rows: of the file, those that cannot be drawn too.
        labels: of each Gaussian, where the file has them.
        photographs: of the scene; None where these are no longer there.
        weights: of CLIP, where they are now; where they were, unless given.
    """

    path: Path
    stored: StoredField
    file: Path
    gaussians: Gaussians
    rows: Int[np.ndarray, "n"]
    num_rows: int
    labels: Int[np.ndarray, "n"] | None
    photographs: Photographs | None
    weights: Path | None = None

    @property
    def rasterize_mode(self) -> str:
        """How its scene was fitted, and is drawn."""
        return str(self.stored.scene.get("rasterize_mode", "classic"))

    @property
    def unit(self) -> str:
        """Of lengths: only a sensor of depth makes them metres."""
        return "m" if self.photographs is not None and self.photographs.load_depth is not None else ""

    @cached_property
    def encoder(self) -> LanguageEncoder:
        """Who reads texts in the space of the field's features.

        Raises:
            ValueError, FileNotFoundError: as `Source.encoder`.
        """
        return self.stored.source.encoder(self.weights)


def field_of(path: Path) -> Path | None:
    """The folder of the field that lies at `path`, or in the run there; None where there is none."""
    return next((folder for folder in (path, path / FOLDER) if (folder / NAME).is_file()), None)


def unfinished_field_of(path: Path) -> Path | None:
    """The folder at `path`, or in the run there, of a distillation that has not written a field; or None."""
    return next((f for f in (path, path / FOLDER) if is_run(f) and _is_of_distill(f / "config.yml")), None)


def _is_of_distill(config: Path) -> bool:
    try:
        return {"scene", "features", "distill"} <= set(yaml.safe_load(config.read_text(encoding="utf-8")))
    except (yaml.YAMLError, UnicodeDecodeError, TypeError):
        return False


def open_field_run(
    folder: Path, notes: Notes, now: Whereabouts = AS_IT_WAS, *, photographs: bool = True
) -> FieldRun:
    """Read it.

    Args:
        folder: that holds field.npz.
        notes: told what is odd.
        now: where things are.
        photographs: whether they are wanted.

    Raises:
        FileNotFoundError: a file of it, or the scene, is missing.
        ValueError: a file holds something else, or the field does not fit the scene; photographs that were
            named cannot be read.
    """
    stored = read_field(folder / NAME)
    file = _scene_file(folder, stored, now.scene, notes)
    gaussians, report = read_drawable(file, notes)
    if stored.rows is None and len(stored.field.encoding) != gaussians.num:
        raise ValueError(
            f"{folder}: expected the scene of its {len(stored.field.encoding)} Gaussians, found "
            f"{gaussians.num} in {file}; --scene names another, or distil it again"
        )
    gaussians = jax.tree.map(jnp.asarray, gaussians)
    shown = _photographs(folder, stored, file, gaussians, now.images, notes) if photographs else None
    of_file = (report.rows, report.stored, report.labels)
    return FieldRun(folder, stored, file, gaussians, *of_file, shown, now.weights)


def _scene_file(folder: Path, stored: StoredField, given: Path | None, notes: Notes) -> Path:
    """The PLY file that a field is of: by what is in it, wherever it was moved to."""
    told, parent = Path(str(stored.scene.get("file"))), folder.absolute().parent
    beside = (parent / "scene.ply", parent / "canonical" / "scene.ply", folder / "scene.ply")
    there = [file for file in (told, *beside) if file.is_file()] if given is None else [given]
    if not there or not there[0].is_file():
        raise FileNotFoundError(
            f"{given or told}: expected the scene of {folder}, found no file; --scene names it"
        )
    fitting = (file for file in there if digest(file) == stored.scene.get("sha256"))
    if (file := next(fitting, None)) is not None:
        return file
    notes.warn(
        f"{there[0]} is not as it was when the field in {folder} was distilled; answers may be wrong "
        "(--scene names another)"
    )
    return there[0]


def _photographs(
    folder: Path, stored: StoredField, file: Path, gaussians: Gaussians, images: str | None, notes: Notes
) -> Photographs | None:
    """Those that the field tells of; None, and a warning, where they are not to be had.

    Raises:
        ValueError: they are not where `images` says.
    """
    told = stored.scene.get("photographs")
    try:
        try:
            options = _options(told, folder, file, images)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{folder / NAME}: expected which photographs it learned from, found others ({error}); "
                "distil it again with this version of gsjax"
            ) from error
        return open_scene(options, gaussians).photographs
    except (ValueError, OSError) as error:
        if images is not None:
            raise ValueError(f"--images {images}: {describe(error)}") from error
        notes.warn(
            f"its photographs cannot be read, so nothing is drawn: {describe(error)} (--images says where "
            "they are now)"
        )
        return None


def _options(settings: Mapping[str, Any], folder: Path, file: Path, images: str | None) -> SceneOptions:
    """What was told `gsjax distill`, as far as it says which photographs."""
    chosen = {name: _tuple(settings[name]) for name in _OF_IMAGES}
    if images is not None:
        chosen["images"] = images
    run, parent = Path(settings["scene"]), folder.absolute().parent
    if run.suffix.lower() != ".ply" and not run.exists() and folder.name == FOLDER and is_run(parent):
        run = parent  # that was moved whole
    return SceneOptions(run if run.is_dir() else file, read=read_options(settings["read"]), **chosen)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def short_names(names: Sequence[str]) -> tuple[str, ...]:
    """Short names of photographs, which files can have: of a recording's one frame, its cameras'."""
    parts = [name.rsplit("/", 1) for name in names]
    if all(len(part) == 2 for part in parts) and len({part[1] for part in parts}) == 1:
        short = [part[0] for part in parts]
        if len(set(short)) == len(short):
            return tuple(short)
    flat = [str(Path(name).with_suffix("")).replace("/", "_") for name in names]
    return tuple(flat) if len(set(flat)) == len(flat) else tuple(name.replace("/", "_") for name in names)
