"""One experiment: the cells of its sweep, and the record of each."""

import hashlib
import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from gsjax.engine.experiments.config import (
    CONFIG,
    Column,
    Config,
    Figure,
    expect,
    expect_unique,
    read_config,
)
from gsjax.engine.experiments.records import RESULTS, committed_rows, read_record
from gsjax.engine.experiments.script import fingerprint_of, load_script, made_with_of, read_script

RESERVED = ("seed", "seconds")
"""Names that a row uses besides options and figures, so neither may have them."""
# YAML 1.1 reads these as text, which a sweep never intends.
_NUMBER_AS_TEXT = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")


@dataclass(frozen=True)
class Cell:
    """One run of the script."""

    options: dict[str, Any]
    seed: int

    @property
    def id(self) -> str:
        """Name of the cell's file: the same for the same options in any order, and on any machine."""
        text = json.dumps([self.options, self.seed], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def words(self) -> dict[str, str]:
        """Options and seed, as text for tables."""
        return {key: in_words(value) for key, value in {**self.options, "seed": self.seed}.items()}

    def __str__(self) -> str:
        return " ".join(f"{key}={text}" for key, text in self.words.items())


@dataclass(frozen=True)
class Experiment:
    """An experiment, checked."""

    name: str
    root: Path  # the folder of all experiments
    cells_folder: Path  # ID.json and the folder ID/ of each cell
    config: Config
    columns: tuple[Column, ...]
    figure: Figure
    cells: tuple[Cell, ...]  # in order; seeds change fastest
    text: str  # the script

    @property
    def folder(self) -> Path:
        """Folder of its config and its collected results."""
        return self.root / self.name

    @property
    def script(self) -> Path:
        """Path of its script."""
        return self.folder / self.config.script

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of its script: records with another one are stale."""
        return fingerprint_of(self.root, self.script, self.text, self.config.version)

    @property
    def made_with(self) -> str:
        """Version of gsjax, and of what the experiments share."""
        return made_with_of(self.root)

    def load(self) -> tuple[Callable, Callable | None]:
        """The script's `run`, and its `figure` or None."""
        return load_script(self.root, self.script, self.text, bool(self.config.figure))

    def path(self, cell: Cell) -> Path:
        """The file of a cell that was run from this machine."""
        return self.cells_folder / f"{cell.id}.json"

    def own(self, cell: Cell) -> dict[str, Any] | None:
        """The record of a cell that was run from this machine, or None."""
        path = self.path(cell)
        return read_record(path) if path.is_file() else None

    def new_record(self, cell: Cell, error: str | None, **outcome: Any) -> dict[str, Any]:
        """The record of a cell that has just ended.

        Args:
            cell: the cell.
            error: why it failed, or None.
            outcome: `result`, `traceback`, `seconds` and `machine`, as far as they are known.
        """
        unknown = {"result": None, "traceback": [], "seconds": None, "machine": None}
        finished = datetime.now(UTC).isoformat(timespec="seconds")
        made = {"finished": finished, "script": self.fingerprint, "gsjax": self.made_with}
        return {"options": cell.options, "seed": cell.seed, "error": error, **unknown, **outcome, **made}

    def is_done(self, record: dict[str, Any] | None) -> bool:
        """Whether a record is of a cell that ran with the current script and did not fail."""
        return record is not None and record["error"] is None and record["script"] == self.fingerprint

    def records(self) -> list[dict[str, Any]]:
        """All records of the cells, in order: this machine's, else those committed.

        A stale or failed one gives way to a committed one that is neither: others may have run it since.
        """
        committed, known = self.committed(), []
        for cell in self.cells:
            candidates = [r for r in (self.own(cell), committed.get(cell.id)) if r is not None]
            known += [next(filter(self.is_done, candidates), candidates[0])] if candidates else []
        return known

    def committed(self) -> dict[str, dict[str, Any]]:
        """The rows of results.json by their cells' ids."""
        rows = committed_rows(self.folder / RESULTS)
        return {Cell(row["options"], row["seed"]).id: row for row in rows}


def in_words(value: Any) -> str:
    """An option's value, as tables show it and `--only` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def experiment_names(root: Path) -> list[str]:
    """The folders below `root` that hold a config, sorted."""
    expect(root.is_dir(), f"{root}", "a folder of experiments (--root names another)", "none there")
    return sorted(path.parent.relative_to(root).as_posix() for path in root.glob(f"*/**/{CONFIG}"))


def read_experiment(root: Path, name: str, out: Path) -> Experiment:
    """Read and check the experiment `name`, whose cells are in `out`/`name`.

    Args:
        root: folder of the experiments.
        name: its folder below that.
        out: folder for the records of cells.

    Raises:
        ValueError: there is none, or its config is invalid.
    """
    names = experiment_names(root)
    # Shell completion gives the path of the folder, with a trailing slash.
    name = next((n for n in names if Path(name) in (Path(n), root / n)), name)
    below = [n for n in names if n.startswith(name.rstrip("/") + "/")]
    known = ", ".join(below or names) or f"none; create one as {root}/NAME/{CONFIG}"
    if name not in names:
        raise ValueError(f"{root}: no experiment {name!r}; available: {known}")
    path = root / name / CONFIG
    config, columns, figure = read_config(path, root)
    cells, text = _cells(config, path), read_script(path.parent / config.script)
    return Experiment(name, root, out / name, config, columns, figure, cells, text)


def _cells(config: Config, path: Path) -> tuple[Cell, ...]:
    """The sweep, in order."""
    expect(config.grid or config.cases, f"{path}: grid", "option: [values], or cases", "nothing to sweep")
    for option, values in config.grid.items():
        where = f"{path}: grid.{option}"
        expect(isinstance(values, list) and values, where, "a list of values", values)
        _expect_option(option, values, where)
    for i, case in enumerate(config.cases):
        where = f"{path}: cases[{i}]"
        expect(isinstance(case, dict) and case, where, "option: value pairs", case)
        for option, value in case.items():
            _expect_option(option, [value], f"{where}.{option}")
            expect(option not in config.grid, f"{where}.{option}", "an option that the grid has not", option)
    sound = config.seeds and all(type(seed) is int for seed in config.seeds)
    expect(sound, f"{path}: seeds", "a list of whole numbers", config.seeds)
    points = [dict(zip(config.grid, p, strict=True)) for p in itertools.product(*config.grid.values())]
    options = [{**case, **point} for case in config.cases or [{}] for point in points]
    cells = tuple(Cell(o, seed) for o in options for seed in config.seeds)
    expect_unique([str(cell) for cell in cells], f"{path}: grid, cases and seeds")
    return cells


def _expect_option(name: Any, values: list, where: str) -> None:
    """Check an option's name, and that JSON can hold its values, so that a cell can be found again."""
    expect(isinstance(name, str) and name not in RESERVED, where, "an option's name", name)
    for value in itertools.chain.from_iterable(v if isinstance(v, list) else [v] for v in values):
        plain = value is None or isinstance(value, (str, int, float))
        expect(plain, where, "numbers, text, true, false, null, or lists of those", value)
        expect(not isinstance(value, float) or math.isfinite(value), where, "finite numbers", value)
        text = isinstance(value, str) and _NUMBER_AS_TEXT.fullmatch(value)
        expect(not text, where, "a number as YAML has it, with a point and a sign (1.0e-3)", value)
