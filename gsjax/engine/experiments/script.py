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

from gsjax.engine.experiments.config import CONFIG, expect


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


def forget_scripts(root: Path) -> None:
    """Have this process load scripts of experiments at `root`, and what stands beside them, anew when they
    are imported next. What else is below `root`, as an environment, stays."""
    folders = {config.parent.resolve() for config in root.resolve().glob(f"*/{CONFIG}")}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and Path(file).resolve().parent in folders:
            del sys.modules[name]
    sys.path[:] = [path for path in sys.path if Path(path).resolve() not in folders]


def fingerprint_of(path: Path, text: str, version: int) -> str:
    """Changes with a script, with what stands beside it and with the config's version.

    Not with what changes no row: the script's function `figure`, and lines that only import from gsjax,
    without `as`, which change where a module moved. Rows say themselves which gsjax made them.

    Args:
        path: of the script.
        text: what stands in it.
        version: the config's.
    """
    beside = sorted(other for other in path.parent.glob("*.py") if other.name != path.name)
    helpers = [_without(other.read_text(encoding="utf-8"), _imports_gsjax) for other in beside]
    script = _without(text, lambda node: _imports_gsjax(node) or _is_figure(node))
    return hashlib.sha256("\n".join([str(version), script, *helpers]).encode()).hexdigest()[:16]


def _is_figure(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and node.name == "figure" and node.col_offset == 0


def _imports_gsjax(node: ast.AST) -> bool:
    """Whether it is an import of nothing but gsjax and its modules, under names that are their own: under
    another name, one thing may stand for another without a change of what uses it."""
    if isinstance(node, ast.Import | ast.ImportFrom) and any(alias.asname for alias in node.names):
        return False
    if isinstance(node, ast.ImportFrom):
        modules = [node.module or ""] if node.level == 0 else [""]
    else:
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [""]
    return all(module.split(".")[0] == "gsjax" for module in modules)


def _without(text: str, left_out: Callable[[ast.AST], bool]) -> str:
    """A module's text but for the lines of the statements that are left out, if they stand there alone."""
    try:
        nodes = [node for node in ast.walk(ast.parse(text)) if left_out(node)]
    except SyntaxError:
        return text  # loading it says so
    lines = text.removesuffix("\n").split("\n")  # as Python counts them: others also split at form feeds
    gone = set()
    for node in nodes:
        before = lines[node.lineno - 1].encode()[: node.col_offset]  # columns are counted in bytes
        behind = lines[node.end_lineno - 1].encode()[node.end_col_offset :].strip()
        if not before.strip() and behind[:1] in (b"", b"#"):
            gone.update(range(node.lineno - 1, node.end_lineno))
    return "\n".join(line for n, line in enumerate(lines) if n not in gone)


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
