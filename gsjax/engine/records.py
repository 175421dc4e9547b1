"""The record of a run, read from its files: its settings, its scores, its curve."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from gsjax.engine.folder import expect_run, is_run, read_values
from gsjax.io.brief import brief
from gsjax.io.parsed import parse_json, parse_yaml

Kind = Literal["fit", "track", "parts", "distill", "deform"]
EVALUATION = Path("eval", "metrics.json")
"""Path of the scores of `gsjax eval`, within the folder of a run."""
_REQUIRED: dict[Kind, tuple[str, ...]] = {
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
    """A run, as recorded in its files.

    Attributes:
        path: its folder.
        kind: the command that made it.
        config: the contents of config.yml.
        metrics: the contents of metrics.json; None while the run is in progress, or if it was killed.
        curve: the rows of metrics.jsonl, for a fit.
        evaluation: the scores of `gsjax eval` for the current scene; None if there are none.
        notes: what was ignored, and why.
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
        """Whether the run was neither stopped nor killed."""
        return self.metrics is not None and bool(self.metrics.get("complete"))


def read_record(path: Path) -> Record:
    """Read the record of a run.

    Raises:
        FileNotFoundError: there is no such folder, or it is no run's.
        ValueError: a file cannot be read, or the run is of a command whose runs are not compared.
    """
    expect_run(path)
    config = read_config(path / "config.yml")
    kind = _kind(path, config)
    metrics = _object(path / "metrics.json", _REQUIRED[kind])
    evaluation, notes = _object(path / EVALUATION, ("scene_sha256", "lpips", "views")), ()
    if evaluation is not None and evaluation.get("scene_sha256") != digest(path / "scene.ply"):
        evaluation = None
        notes = (
            f"{path}: the scores of `gsjax eval` are of an earlier scene and are left out; run it again.",
        )
    return Record(path, kind, config, metrics, _lines(path / "metrics.jsonl", kind), evaluation, notes)


def kind_of(path: Path) -> Kind | None:
    """The command that made the run in a folder; None if there is no run, or one of another command."""
    try:
        return _kind(path, read_config(path / "config.yml")) if is_run(path) else None
    except ValueError:
        return None


def is_of_live(path: Path) -> bool:
    """Whether a run is one of `gsjax live`."""
    metrics = path / "metrics.json"
    return metrics.is_file() and read_values(metrics, parse_json).get("kind") == "live"


def digest(file: Path) -> str | None:
    """SHA-256 of a file, to identify a scene; None if there is no file."""
    if not file.is_file():
        return None
    with open(file, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_config(file: Path) -> dict[str, Any]:
    """The settings of a run.

    Raises:
        ValueError: the file holds something else.
    """
    return read_values(file, parse_yaml)


def _kind(path: Path, config: Mapping[str, Any]) -> Kind:
    """The command that made a run; the settings of `gsjax parts` include those of a fit."""
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
        f"of another command or version ({brief(', '.join(map(str, list(config)[:6])))})"
    )


def _object(file: Path, wanted: tuple[str, ...]) -> dict[str, Any] | None:
    """The contents of a JSON file with these entries, if it exists."""
    if not file.is_file():
        return None
    found = read_values(file, parse_json)
    _expect(file, found, wanted)
    return found


def _lines(file: Path, kind: Kind) -> list[dict[str, Any]]:
    if not file.is_file():
        return []
    try:
        rows = [parse_json(line) for line in file.read_text(encoding="utf-8").splitlines() if line]
    except ValueError as error:
        raise ValueError(f"{file}: expected JSON on each line, found something else ({error})") from error
    for row in rows:
        _expect(file, row, _CURVES.get(kind, ()))
    return rows


def _expect(file: Path, found: Any, wanted: tuple[str, ...]) -> None:
    missing = [name for name in wanted if not isinstance(found, dict) or name not in found]
    if missing:
        raise ValueError(
            f"{file}: expected {', '.join(wanted)}, found no {missing[0]}: the file is of another "
            "version of gsjax; run the command again"
        )
