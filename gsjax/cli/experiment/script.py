"""The script of an experiment: loading it, and the fingerprint that says what made a row."""

import ast
import hashlib
import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType

from gsjax.cli.experiment.config import expect


def load_script(name: str, path: Path, text: str, described: bool) -> tuple[Callable, Callable | None]:
    """A script's `run`, and its `figure` or None.

    Args:
        name: of the experiment.
        path: of the script.
        text: what stands in it; what runs is the text that the fingerprint is of.
        described: whether the config describes a figure, so that there has to be one.

    Raises:
        ValueError: it cannot be loaded, or lacks a function.
    """
    module = ModuleType("gsjax_experiment_" + re.sub(r"\W", "_", name))
    module.__file__ = str(path)
    sys.modules[module.__name__] = module  # dataclasses and pickle look it up there
    beside = str(path.resolve().parent)  # helpers may stand there, as with `python script.py`
    if beside not in sys.path:
        sys.path.insert(0, beside)
    try:
        exec(compile(text, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        found = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: expected a script that can be loaded, found {found}") from error
    run, figure = getattr(module, "run", None), getattr(module, "figure", None)
    expect(callable(run), f"{path}", "a function run(options, seed, folder)", "none")
    wanted = "a function figure(rows, path), which the config describes"
    expect(callable(figure) or not described, f"{path}", wanted, "none")
    return run, figure


def fingerprint_of(path: Path, text: str, version: int) -> str:
    """Changes with a script, with what stands beside it and with the config's version; not with its function
    `figure`, which changes no row.

    Args:
        path: of the script.
        text: what stands in it.
        version: the config's.
    """
    beside = sorted(other for other in path.parent.glob("*.py") if other.name != path.name)
    texts = [_without_figure(text), *(other.read_text(encoding="utf-8") for other in beside)]
    return hashlib.sha256("\n".join([str(version), *texts]).encode()).hexdigest()[:16]


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


def made_with_of(root: Path) -> str:
    """Version of gsjax, and a hash of its sources and of what experiments share at their root: rows of one
    table may have been made with several, which is said below it."""
    return f"{import_module('gsjax').__version__}+{_hash_of(root.resolve())}"


@cache
def _hash_of(root: Path) -> str:
    """Of gsjax's files and those at the root of the experiments, as they are when first asked for."""
    package = Path(import_module("gsjax").__file__).parent
    paths = sorted(package.rglob("*.py")) + sorted(root.glob("*.py"))
    return hashlib.sha256(b"\n".join(path.read_bytes() for path in paths)).hexdigest()[:8]
