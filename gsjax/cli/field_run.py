"""The folder of `gsjax distill` read back: the field, its scene, and the photographs of it."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import yaml

from gsjax.cli.distill import FOLDER, Options, open_scene
from gsjax.cli.field_file import NAME, StoredField, read_field
from gsjax.cli.field_scene import FieldScene
from gsjax.cli.messages import Notes, describe
from gsjax.cli.run_records import digest
from gsjax.data.open import ReadOptions
from gsjax.io.ply import read_ply
from gsjax.scene.gaussians import Gaussians

_OF_IMAGES = ("images", "scale", "frames", "cameras", "eval_cameras", "test_every")


@dataclass(frozen=True, eq=False)
class FieldRun:
    """A field and what it is of.

    Attributes:
        path: its folder.
        stored: the field.
        gaussians: the scene.
        views: the same with photographs; None where these are no longer there.
    """

    path: Path
    stored: StoredField
    gaussians: Gaussians
    views: FieldScene | None

    @property
    def rasterize_mode(self) -> str:
        return str(self.stored.scene.get("rasterize_mode", "classic"))


def field_of(path: Path) -> Path | None:
    """The folder of the field that lies at `path`, or in the run there; None where there is none."""
    return next((folder for folder in (path, path / FOLDER) if (folder / NAME).is_file()), None)


def open_field_run(folder: Path, notes: Notes) -> FieldRun:
    """Read it.

    Raises:
        FileNotFoundError: a file of it, or the scene, is missing.
        ValueError: a file holds something else, or the field does not fit the scene.
    """
    stored = read_field(folder / NAME)
    file, config = Path(str(stored.scene.get("file"))), folder / "config.yml"
    beside = folder.parent / "scene.ply"  # a run that was moved whole
    file = beside if not file.is_file() and beside.is_file() else file
    if not file.is_file():
        raise FileNotFoundError(f"{file}: expected the scene of {folder}, found no file; put it back")
    gaussians = jax.tree.map(jnp.asarray, read_ply(file)[0])
    if digest(file) != stored.scene.get("sha256"):
        notes.warn(f"{file} is not as it was when its field was distilled; answers may be wrong")
    if stored.rows is None and len(stored.field.encoding) != gaussians.num:
        raise ValueError(
            f"{folder}: expected the scene of its {len(stored.field.encoding)} Gaussians, found "
            f"{gaussians.num} in {file}; distil it again"
        )
    try:
        views = open_scene(_options(yaml.safe_load(config.read_text(encoding="utf-8")), folder))
    except (ValueError, OSError, yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        notes.warn(f"its photographs are not there, so no masks are drawn: {describe(error)}")
        views = None
    return FieldRun(folder, stored, gaussians, views)


def _options(settings: dict[str, Any], folder: Path) -> Options:
    """What was told `gsjax distill`, as far as it says which photographs."""
    chosen = {name: _tuple(settings[name]) for name in _OF_IMAGES}
    known = {field.name for field in fields(ReadOptions)}
    read = ReadOptions(**{n: _tuple(v) for n, v in settings["read"].items() if n in known})
    scene = Path(settings["scene"])
    moved = not scene.exists() and folder.name == FOLDER
    return Options(folder.parent if moved else scene, read=read, **chosen)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def camera_names(names: Sequence[str]) -> tuple[str, ...]:
    """Short names of photographs, which files can have: of a recording's one frame, its cameras'."""
    parts = [name.rsplit("/", 1) for name in names]
    if all(len(part) == 2 for part in parts) and len({part[1] for part in parts}) == 1:
        short = [part[0] for part in parts]
        if len(set(short)) == len(short):
            return tuple(short)
    flat = [str(Path(name).with_suffix("")).replace("/", "_") for name in names]
    return tuple(flat) if len(set(flat)) == len(flat) else tuple(name.replace("/", "_") for name in names)
