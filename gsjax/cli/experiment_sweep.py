"""One experiment: its config.yaml, its script, the cells of its sweep, and what is known of each."""

import ast
import contextlib
import copy
import dataclasses
import difflib
import hashlib
import itertools
import json
import math
import re
import shutil
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib import import_module
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

import yaml

from gsjax.cli import machine
from gsjax.cli.messages import describe
from gsjax.io.atomic import write_json
from gsjax.optim.compiler import forget_programs

CONFIG, RESULTS = "config.yaml", "results.json"
FIGURES = (".png", ".svg", ".jpg", ".webp")
RESERVED = ("seed", "seconds")
"""What a row holds beside options and figures, so neither may have these names."""
RECORD = ("options", "seed", "script", "result", "error", "seconds", "finished", "machine", "gsjax")
"""What the file of a cell holds; `script` is the fingerprint of what made it, `finished` is UTC, ISO 8601."""
_ADVICE = "delete the file to do without it"
_WORDS = {str: "text", int: "a whole number", list: "a list", dict: "key: value pairs"}
# YAML 1.1 takes these for text, which nobody means who sweeps a rate.
_LOOKS_LIKE_A_NUMBER = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    key: str  # of what `run` returns, or seconds
    label: str = ""  # the key unless given
    unit: str = ""
    direction: str = ""  # lower or higher: which is better
    format: str = ""  # as Python's format() has it, such as .2f; three digits unless given


@dataclass(frozen=True)
class Figure:
    """What `figure(rows, path)` of the script draws."""

    file: str = "figure.png"
    caption: str = ""


@dataclass(frozen=True)
class Config:
    """What config.yaml says; its keys are these names."""

    claim: str  # one sentence
    source: str  # where it is made: paper and section, or else
    script: str  # path from the config's folder, with `run(options, seed, folder)`; several may share one
    grid: dict = field(default_factory=dict)  # option: [values]; all combinations, the last option fastest
    cases: list = field(default_factory=list)  # of option: value pairs; the grid is swept in each
    seeds: list = field(default_factory=lambda: [0])
    columns: list = field(default_factory=list)  # of Column; none for all figures
    figure: dict = field(default_factory=dict)  # a Figure
    version: int = 1  # raise it to have all cells measured again


@dataclass(frozen=True)
class Cell:
    """One run of the script."""

    options: dict[str, Any]
    seed: int

    @property
    def id(self) -> str:
        """Names the cell's file: the same for the same options in any order, and on any machine."""
        text = json.dumps([self.options, self.seed], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def words(self) -> dict[str, str]:
        """Options and seed as tables show them."""
        return {key: in_words(value) for key, value in {**self.options, "seed": self.seed}.items()}

    def __str__(self) -> str:
        return " ".join(f"{key}={text}" for key, text in self.words.items())


@dataclass(frozen=True)
class Experiment:
    """An experiment, checked."""

    name: str
    folder: Path  # of its config and its collected results
    cells_folder: Path  # ID.json and the folder ID/ of each cell
    config: Config
    columns: tuple[Column, ...]
    figure: Figure
    cells: tuple[Cell, ...]  # in order; seeds change fastest
    text: str  # the script

    @property
    def script(self) -> Path:
        return self.folder / self.config.script

    @property
    def fingerprint(self) -> str:
        """Changes with the script but for its `figure`, with what stands beside it and with the config's
        version: what was made under another one is stale."""
        beside = sorted(path for path in self.script.parent.glob("*.py") if path.name != self.script.name)
        texts = [_without_figure(self.text), *(path.read_text(encoding="utf-8") for path in beside)]
        return hashlib.sha256("\n".join([str(self.config.version), *texts]).encode()).hexdigest()[:16]

    @property
    def made_with(self) -> str:
        """Version of gsjax, and a hash of its sources and of what experiments share at the root: rows
        of one table may have been made with several, which is said below it."""
        root = self.folder.parents[len(Path(self.name).parts) - 1]
        return f"{import_module('gsjax').__version__}+{_hash_of(root.resolve())}"

    def path(self, cell: Cell) -> Path:
        """The file of a cell that ran on this machine."""
        return self.cells_folder / f"{cell.id}.json"

    def own(self, cell: Cell) -> dict[str, Any] | None:
        """The record of a cell that ran on this machine, or None."""
        path = self.path(cell)
        return _record(_json(path), path) if path.is_file() else None

    def is_done(self, record: dict[str, Any] | None) -> bool:
        """Whether nothing is left to do: it ran, by the present script, and did not fail."""
        return record is not None and record["error"] is None and record["script"] == self.fingerprint

    def records(self) -> list[dict[str, Any]]:
        """All that is known of the cells, in order: this machine's records, else those committed.

        One that is stale or failed gives way to a committed one that is not: others may have measured since.
        """
        committed, known = self.committed(), []
        for cell in self.cells:
            candidates = [r for r in (self.own(cell), committed.get(cell.id)) if r is not None]
            known += [next(filter(self.is_done, candidates), candidates[0])] if candidates else []
        return known

    def committed(self) -> dict[str, dict[str, Any]]:
        """The rows of results.json by their cells' ids; what is the same in all of them stands above them."""
        path = self.folder / RESULTS
        found = _json(path) if path.is_file() else {"same": {}, "rows": []}
        try:
            rows = [_record({"error": None, **found["same"], **row}, path) for row in found["rows"]]
        except (TypeError, KeyError) as error:  # no dict, or not of dicts
            raise ValueError(
                f"{path}: expected rows as gsjax writes them, found {error}; {_ADVICE}"
            ) from error
        return {Cell(row["options"], row["seed"]).id: row for row in rows}

    def load(self) -> tuple[Callable, Callable | None]:
        """The script's `run`, and its `figure` or None. What runs is the text that the fingerprint is of."""
        module = ModuleType("gsjax_experiment_" + re.sub(r"\W", "_", self.name))
        module.__file__ = str(self.script)
        sys.modules[module.__name__] = module  # dataclasses and pickle look it up there
        beside = str(self.script.resolve().parent)  # helpers may stand there, as with `python script.py`
        if beside not in sys.path:
            sys.path.insert(0, beside)
        try:
            exec(compile(self.text, str(self.script), "exec"), module.__dict__)
        except (Exception, SystemExit) as error:
            found = f"{type(error).__name__}: {error}"
            raise ValueError(f"{self.script}: expected a script that can be loaded, found {found}") from error
        run, figure = getattr(module, "run", None), getattr(module, "figure", None)
        _expect(callable(run), f"{self.script}", "a function run(options, seed, folder)", "none")
        wanted = "a function figure(rows, path), which the config describes"
        _expect(callable(figure) or not self.config.figure, f"{self.script}", wanted, "none")
        return run, figure


def _without_figure(script: str) -> str:
    """A script's text but for its top-level function `figure`: a plot drawn otherwise changes no row."""
    try:
        figures = [f for f in ast.parse(script).body if isinstance(f, ast.FunctionDef) and f.name == "figure"]
    except SyntaxError:
        return script  # loading it says so
    lines = script.removesuffix("\n").split("\n")  # as Python counts them: others also split at form feeds
    for f in reversed(figures):
        del lines[f.lineno - 1 : f.end_lineno]
    return "\n".join(lines)


@cache
def _hash_of(root: Path) -> str:
    """Of gsjax's files and those at the root of the experiments, as they are when first asked for."""
    package = Path(import_module("gsjax").__file__).parent
    paths = sorted(package.rglob("*.py")) + sorted(root.glob("*.py"))
    return hashlib.sha256(b"\n".join(path.read_bytes() for path in paths)).hexdigest()[:8]


def run_cell(experiment: Experiment, cell: Cell, script_run: Callable, debug: bool = False) -> dict[str, Any]:
    """Run one cell and keep its record, also if it fails; only Ctrl-C leaves none. Returns the record.

    Args:
        script_run: `run(options, seed, folder)` of the script. The folder is the cell's own, and new.
        debug: let through what it raises.
    """
    folder, path = experiment.cells_folder / cell.id, experiment.path(cell)
    shutil.rmtree(folder, ignore_errors=True)  # a run that was stopped may have left half of something
    folder.mkdir(parents=True, exist_ok=True)
    made_with = experiment.made_with
    forget_programs()  # of earlier cells
    result, error, trace, begun = None, None, [], perf_counter()
    try:
        result = script_run(copy.deepcopy(cell.options), cell.seed, folder)
        _check_result(result, cell)
    except (Exception, SystemExit) as failure:
        if debug:
            raise
        kind = type(failure).__name__
        result, error = None, f"{kind}: {describe(failure)}".removesuffix(f": {kind}")
        trace = traceback.format_exc().splitlines()
    record = {
        "options": cell.options,
        "seed": cell.seed,
        "result": result,
        "error": error,
        "traceback": trace,
        "seconds": perf_counter() - begun,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "script": experiment.fingerprint,
        "machine": machine.describe(),  # asked after the script ran, which may configure JAX first
        "gsjax": made_with,
    }
    write_json(path, record)
    with contextlib.suppress(OSError):  # files of the script's are in it
        folder.rmdir()
    return _json(path)  # as a later run will see it: arrays are lists, NaN is null


def _check_result(result: Any, cell: Cell) -> None:
    """Raises a TypeError unless it is a dict of what JSON can hold, by names that are not taken."""
    if not isinstance(result, Mapping):
        raise TypeError(f"run() returned {type(result).__name__}, expected a dict of figures by name")
    for key, value in result.items():
        if not isinstance(key, str) or key in (*RESERVED, *cell.options):
            raise TypeError(f"run() returned {key!r}, expected a name that is no option, seed or seconds")
        try:
            json.dumps(value, default=lambda array: array.tolist())
        except (TypeError, ValueError, AttributeError) as error:
            found = f"{key!r} of type {type(value).__name__}"
            raise TypeError(f"run() returned {found}, expected numbers, text, or lists of them") from error


def in_words(value: Any) -> str:
    """An option's value as tables show it and `--only` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def experiment_names(root: Path) -> list[str]:
    """The folders below `root` that hold a config, sorted."""
    _expect(root.is_dir(), f"{root}", "a folder of experiments (--root names another)", "none there")
    return sorted(path.parent.relative_to(root).as_posix() for path in root.glob(f"*/**/{CONFIG}"))


def read_experiment(root: Path, name: str, out: Path) -> Experiment:
    """Read and check the experiment `name`, whose cells are in `out`/`name`.

    Raises:
        ValueError: there is none, or a key of its config is not as it should be.
    """
    names = experiment_names(root)
    # A shell completes the path of the folder, with a slash at its end.
    name = next((n for n in names if Path(name) in (Path(n), root / n)), name)
    below = [n for n in names if n.startswith(name.rstrip("/") + "/")]
    known = ", ".join(below or names) or f"none; make one as {root}/NAME/{CONFIG}"
    if name not in names:
        raise ValueError(f"{root}: no experiment {name!r}; there are: {known}")
    path = root / name / CONFIG
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        said = f"a fault in line {mark.line + 1}: {problem}" if mark else str(error)
        raise ValueError(f"{path}: expected YAML, found {said}") from error
    config = _fields(Config, found, f"{path}", ": ")
    for key in ("claim", "source", "script"):
        _expect(getattr(config, key).strip(), f"{path}: {key}", "text", "none")
    script = path.parent / config.script
    within = script.resolve().is_relative_to(root.resolve())
    _expect(within, f"{path}: script", f"a path within {root}", config.script)
    _expect(script.is_file(), f"{path}: script", "a file", f"none at {script}")
    columns = tuple(_column(value, f"{path}: columns[{i}]") for i, value in enumerate(config.columns))
    _expect_unlike([column.key for column in columns], f"{path}: columns")
    figure = _fields(Figure, config.figure, f"{path}: figure")
    fits = Path(figure.file).name == figure.file and Path(figure.file).suffix in FIGURES
    _expect(fits, f"{path}: figure.file", f"a file name in {', '.join(FIGURES)}", figure.file)
    cells, text = _cells(config, path), script.read_text(encoding="utf-8")
    return Experiment(name, path.parent, out / name, config, columns, figure, cells, text)


def _cells(config: Config, path: Path) -> tuple[Cell, ...]:
    """The sweep, in order."""
    _expect(config.grid or config.cases, f"{path}: grid", "option: [values], or cases", "nothing to sweep")
    for option, values in config.grid.items():
        where = f"{path}: grid.{option}"
        _expect(isinstance(values, list) and values, where, "a list of values", values)
        _expect_option(option, values, where)
    for i, case in enumerate(config.cases):
        where = f"{path}: cases[{i}]"
        _expect(isinstance(case, dict) and case, where, "option: value pairs", case)
        for option, value in case.items():
            _expect_option(option, [value], f"{where}.{option}")
            _expect(option not in config.grid, f"{where}.{option}", "an option that the grid has not", option)
    sound = config.seeds and all(type(seed) is int for seed in config.seeds)
    _expect(sound, f"{path}: seeds", "a list of whole numbers", config.seeds)
    points = [dict(zip(config.grid, p, strict=True)) for p in itertools.product(*config.grid.values())]
    options = [{**case, **point} for case in config.cases or [{}] for point in points]
    cells = tuple(Cell(o, seed) for o in options for seed in config.seeds)
    _expect_unlike([str(cell) for cell in cells], f"{path}: grid, cases and seeds")
    return cells


def _expect_option(name: Any, values: list, where: str) -> None:
    """Options have names, and values that JSON can hold, so that a cell can be found again."""
    _expect(isinstance(name, str) and name not in RESERVED, where, "an option's name", name)
    for value in itertools.chain.from_iterable(v if isinstance(v, list) else [v] for v in values):
        plain = value is None or isinstance(value, (str, int, float))
        _expect(plain, where, "numbers, text, true, false, null, or lists of those", value)
        _expect(not isinstance(value, float) or math.isfinite(value), where, "finite numbers", value)
        text = isinstance(value, str) and _LOOKS_LIKE_A_NUMBER.fullmatch(value)
        _expect(not text, where, "a number as YAML has it, with a point and a sign (1.0e-3)", value)


def _column(value: Any, where: str) -> Column:
    column = _fields(Column, value, where)
    known = column.direction in ("", "lower", "higher")
    _expect(known, f"{where}.direction", "lower or higher", column.direction)
    try:
        format(1.0, column.format)
    except ValueError:
        _expect(False, f"{where}.format", "one of Python's for a number, such as .2f", column.format)
    return column


def _fields(kind: type, value: Any, where: str, separator: str = ".") -> Any:
    """The dataclass of a mapping: its keys are known, types are as annotated, and nothing is missing."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    _expect(isinstance(value, dict), where, f"the keys {', '.join(fields)}", value)
    for key in value:
        meant = difflib.get_close_matches(str(key), fields, 1)
        found = f"{key!r}" + (f"; did you mean {meant[0]!r}?" if meant else "")
        _expect(key in fields, where, f"the keys {', '.join(fields)}", found)
    for key, f in fields.items():
        required = f.default is MISSING and f.default_factory is MISSING
        sound = isinstance(value.get(key), f.type) and not isinstance(value[key], bool)
        if key in value or required:
            _expect(sound, f"{where}{separator}{key}", _WORDS[f.type], value.get(key))
    return kind(**value)


def _expect(holds: Any, where: str, expected: str, found: Any) -> None:
    if not holds:
        said = (
            "nothing"
            if found is None
            else found
            if isinstance(found, str)
            else json.dumps(found, default=str)
        )
        raise ValueError(f"{where}: expected {expected}, found {said}")


def _expect_unlike(names: list[str], where: str) -> None:
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    _expect(not twice, where, "each once", f"{', '.join(twice)} more than once")


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, found {error}; {_ADVICE}") from error


def _record(found: Any, path: Path) -> dict[str, Any]:
    """What was read from `path`, if it is the record of a cell."""
    lacks = [key for key in RECORD if key not in found] if isinstance(found, dict) else [*RECORD]
    _expect(not lacks, f"{path}", "the record of a cell", f"none: no {', '.join(lacks)}; {_ADVICE}")
    return found
