"""The config.yaml of an experiment, and its validation."""

import dataclasses
import difflib
import json
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any

from gsjax.data.files import read_text
from gsjax.io.parsed import parse_yaml

CONFIG = "config.yaml"
FIGURES = (".png", ".svg", ".jpg", ".webp")
_WORDS = {str: "text", int: "a whole number", list: "a list", dict: "key: value pairs"}


@dataclass(frozen=True)
class Column:
    """A column of the table."""

    key: str  # of the result of `run`, or seconds
    label: str = ""  # default: the key
    unit: str = ""
    direction: str = ""  # lower or higher: which is better
    format: str = ""  # for Python's format(), such as .2f; default: three digits


@dataclass(frozen=True)
class Figure:
    """The figure that `figure(rows, path)` of the script draws."""

    file: str = "figure.png"
    caption: str = ""


@dataclass(frozen=True)
class Config:
    """The contents of config.yaml, by its keys."""

    claim: str  # one sentence
    source: str  # of the claim: paper and section, or other
    script: str  # path from the config's folder, with `run(options, seed, folder)`; several may share one
    grid: dict = field(default_factory=dict)  # option: [values]; all combinations, the last option fastest
    cases: list = field(default_factory=list)  # of option: value pairs; the grid is swept in each
    seeds: list = field(default_factory=lambda: [0])
    columns: list = field(default_factory=list)  # of Column; none for all figures
    figure: dict = field(default_factory=dict)  # a Figure
    version: int = 1  # increase it to run all cells again


def read_config(path: Path, root: Path) -> tuple[Config, tuple[Column, ...], Figure]:
    """Read the config.yaml at `path` and check all of it but the sweep, which `read_experiment` checks. The
    folder of all experiments, `root`, must contain the script.

    Raises:
        ValueError: the file is not YAML, or a key is invalid.
    """
    text = read_text(path, "YAML")
    try:
        found = parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{path}: expected YAML, found a fault: {error}") from error
    config = _fields(Config, found, f"{path}", ": ")
    for key in ("claim", "source", "script"):
        expect(getattr(config, key).strip(), f"{path}: {key}", "text", "none")
    script = path.parent / config.script
    within = script.resolve().is_relative_to(root.resolve())
    expect(within, f"{path}: script", f"a path within {root}", config.script)
    expect(script.is_file(), f"{path}: script", "a file", f"none at {script}")
    columns = tuple(_column(value, f"{path}: columns[{i}]") for i, value in enumerate(config.columns))
    expect_unique([column.key for column in columns], f"{path}: columns")
    figure = _fields(Figure, config.figure, f"{path}: figure")
    fits = Path(figure.file).name == figure.file and Path(figure.file).suffix in FIGURES
    expect(fits, f"{path}: figure.file", f"a file name in {', '.join(FIGURES)}", figure.file)
    return config, columns, figure


def _column(value: Any, where: str) -> Column:
    column = _fields(Column, value, where)
    known = column.direction in ("", "lower", "higher")
    expect(known, f"{where}.direction", "lower or higher", column.direction)
    try:
        format(1.0, column.format)
    except ValueError:
        expect(False, f"{where}.format", "one of Python's for a number, such as .2f", column.format)
    return column


def _fields(kind: type, value: Any, where: str, separator: str = ".") -> Any:
    """The dataclass of a mapping; raises a ValueError for unknown keys, wrong types and missing values."""
    fields = {f.name: f for f in dataclasses.fields(kind)}
    expect(isinstance(value, dict), where, f"the keys {', '.join(fields)}", value)
    for key in value:
        meant = difflib.get_close_matches(str(key), fields, 1)
        found = f"{key!r}" + (f"; did you mean {meant[0]!r}?" if meant else "")
        expect(key in fields, where, f"the keys {', '.join(fields)}", found)
    for key, f in fields.items():
        required = f.default is MISSING and f.default_factory is MISSING
        sound = isinstance(value.get(key), f.type) and not isinstance(value[key], bool)
        if key in value or required:
            expect(sound, f"{where}{separator}{key}", _WORDS[f.type], value.get(key))
    return kind(**value)


def expect(holds: Any, where: str, expected: str, found: Any) -> None:
    """Raises a ValueError that says where, what was expected and what was found, unless `holds`."""
    if holds:
        return
    found = "nothing" if found is None else found
    text = found if isinstance(found, str) else json.dumps(found, default=str)
    raise ValueError(f"{where}: expected {expected}, found {text}")


def expect_unique(names: list[str], where: str) -> None:
    """Raises a ValueError with the names that occur more than once."""
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    expect(not twice, where, "each once", f"{', '.join(twice)} more than once")
