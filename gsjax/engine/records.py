"""What the files of a run say of it: its settings, its scores, how it went on."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from gsjax.engine.folder import expect_run, is_run

Kind = Literal["fit", "track", "parts", "distill", "deform"]
EVALUATION = Path("eval", "metrics.json")
"""Where `gsjax eval` writes what it found, within the folder of a run."""
_SCORES: dict[Kind, tuple[str, ...]] = {
    "fit": ("dataset", "size", "photographs", "views", "seconds", "steps", "num_gaussians", "machine"),
    "track": (
        *("dataset", "image", "frames", "tracked_cameras", "held_out_cameras", "objects", "iou"),
        *("tracked", "held_out", "update_hz", "gaussians", "machine"),
    ),
    "parts": (
        *("dataset", "image", "frames", "tracked_cameras", "held_out_cameras", "parts", "num_parts"),
        *("tracked", "held_out", "update_s", "num_gaussians", "machine"),
    ),
    "distill": ("dataset", "size", "judged_by", "views", "test", "seconds", "steps", "trained", "machine"),
    "deform": ("dataset", "size", "judged_by", "frames", "test", "tracks", "seconds", "steps", "machine"),
}
_CURVES: dict[Kind, tuple[str, ...]] = {"fit": ("step", "seconds", "alive", "test_psnr")}


@dataclass(frozen=True)
class Record:
    """A run, as its files tell.

    Attributes:
        path: its folder.
        kind: the command that made it.
        config: what config.yml says.
        metrics: what metrics.json says; None while the run goes on, or where it was killed.
        curve: the rows of metrics.jsonl, of a fit.
        evaluation: what `gsjax eval` found for the scene that lies there now; None where nothing did.
        notes: why something of it is not taken.
    """

    path: Path
    kind: Kind
    config: dict[str, Any]
    metrics: dict[str, Any] | None
    curve: list[dict[str, Any]] = field(default_factory=list)
    evaluation: dict[str, Any] | None = None
    notes: tuple[str, ...] = ()

    @property
    def complete(self) -> bool:
        """Whether it was neither stopped nor killed."""
        return self.metrics is not None and bool(self.metrics.get("complete"))


def read_record(path: Path) -> Record:
    """Read what a run wrote of itself.

    Raises:
        FileNotFoundError: there is no such folder, or it is no run's.
        ValueError: a file of it cannot be read, or the run is of a command whose runs are not compared.
    """
    expect_run(path)
    config = read_config(path / "config.yml")
    kind = _kind(path, config)
    metrics = _object(path / "metrics.json", _SCORES[kind])
    evaluation, notes = _object(path / EVALUATION, ("scene_sha256", "lpips", "views")), ()
    if evaluation is not None and evaluation.get("scene_sha256") != digest(path / "scene.ply"):
        evaluation = None
        notes = (f"{path}: what `gsjax eval` found is of an earlier scene and is left out; run it again.",)
    return Record(path, kind, config, metrics, _lines(path / "metrics.jsonl", kind), evaluation, notes)


def kind_of(path: Path) -> Kind | None:
    """The command that made the run in a folder; None if there is no run, or one of another command."""
    try:
        return _kind(path, read_config(path / "config.yml")) if is_run(path) else None
    except ValueError:
        return None


def digest(file: Path) -> str | None:
    """SHA-256 of a file, which tells one scene from another; None where there is no file."""
    if not file.is_file():
        return None
    with open(file, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_config(file: Path) -> dict[str, Any]:
    """The settings of a run.

    Raises:
        ValueError: they are none.
    """
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(
            f"{file}: expected the settings of a run, found what is no YAML ({error})"
        ) from error
    if not isinstance(config, dict):
        raise ValueError(f"{file}: expected the settings of a run, found none")
    return config


def _kind(path: Path, config: Mapping[str, Any]) -> Kind:
    """The command that made a run: `gsjax parts` has the settings of a fit among its own."""
    marks: dict[Kind, tuple[str, ...]] = {
        "parts": ("parts", "anchor"),
        "distill": ("distill", "features"),
        "deform": ("deform", "tools"),
        "fit": ("fit", "test_every"),
        "track": ("track", "eval_cameras"),
    }
    for kind, names in marks.items():
        if all(name in config for name in names):
            return kind
    raise ValueError(
        f"{path}: expected a run of {', '.join(f'`gsjax {kind}`' for kind in sorted(marks))}, found settings "
        f"of another command or version ({', '.join(list(config)[:6])})"
    )


def _object(file: Path, wanted: tuple[str, ...]) -> dict[str, Any] | None:
    """A JSON file with these entries, if it is there."""
    if not file.is_file():
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{file}: expected the scores of a run, found what is no JSON ({error})") from error
    _expect(file, found, wanted)
    return found


def _lines(file: Path, kind: Kind) -> list[dict[str, Any]]:
    if not file.is_file():
        return []
    try:
        rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines() if line]
    except ValueError as error:
        raise ValueError(f"{file}: expected a line of JSON each, found others ({error})") from error
    for row in rows:
        _expect(file, row, _CURVES.get(kind, ()))
    return rows


def _expect(file: Path, found: Any, wanted: tuple[str, ...]) -> None:
    missing = [name for name in wanted if not isinstance(found, dict) or name not in found]
    if missing:
        raise ValueError(
            f"{file}: expected {', '.join(wanted)}, found no {missing[0]}: it is of another version of "
            "gsjax; run it again"
        )
