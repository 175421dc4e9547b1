"""The script of an experiment: loading it, and its fingerprint."""

import ast
import hashlib
import sys
import tokenize
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from gsjax.engine.experiments.config import CONFIG, expect

SHARED = "shared"
"""Folder below the root with modules that experiments share."""


def read_script(path: Path) -> str:
    """The source of a script, in the encoding that it declares (default: UTF-8).

    Raises:
        ValueError: it is in another encoding.
        OSError: it cannot be read.
    """
    try:
        with tokenize.open(path) as file:
            return file.read()
    except (SyntaxError, UnicodeDecodeError) as error:
        wanted = "a script in UTF-8, or in the encoding that it declares"
        raise ValueError(f"{path}: expected {wanted}, found a fault: {error}") from error


def load_script(root: Path, path: Path, text: str, described: bool) -> tuple[Callable, Callable | None]:
    """A script's `run`, and its `figure` or None.

    The script is the module of its path, `experiments.NAME.sweep`, as with `python -m` from the parent of the
    root. So it may import shared modules, `experiments.shared.recordings`, and modules beside the root, such
    as `benchmarks`; and also, as with `python sweep.py`, modules beside itself.

    Args:
        root: the folder of all experiments.
        path: path of the script.
        text: the script's source; the text that was fingerprinted is the text that runs.
        described: whether the config describes a figure, which must then exist.

    Raises:
        ValueError: it cannot be loaded, or lacks a function.
    """
    _make_importable(root.resolve())
    if (beside := str(path.resolve().parent)) not in sys.path:
        sys.path.insert(0, beside)
    name = _module_name(root, path)
    spec = spec_from_file_location(name, path)
    assert spec is not None
    module = module_from_spec(spec)
    import_module("gsjax.viz")  # then the script can import matplotlib whatever MPLBACKEND says
    sys.modules[name] = module  # where dataclasses, pickle and other scripts look it up
    try:
        exec(compile(text, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        sys.modules.pop(name, None)
        found = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: expected a script that can be loaded, found {found}") from error
    run, figure = getattr(module, "run", None), getattr(module, "figure", None)
    expect(callable(run), f"{path}", "a function run(options, seed, folder)", "none")
    assert callable(run)
    wanted = "a function figure(rows, path), which the config describes"
    expect(callable(figure) or not described, f"{path}", wanted, "none")
    return run, figure if callable(figure) else None


def _make_importable(root: Path) -> None:
    """Put the parent of the root on Python's path, and make the root a package of its name.

    Another folder of that name on the path, such as that of a checkout of gsjax, would otherwise be searched
    as well. A package with an `__init__.py` is left alone.
    """
    if str(root.parent) not in sys.path:
        sys.path.insert(0, str(root.parent))
    known = sys.modules.get(root.name)
    is_regular = getattr(known, "__file__", None) is not None or (root / "__init__.py").exists()
    if is_regular or list(getattr(known, "__path__", ())) == [str(root)]:
        return
    for name in [name for name in sys.modules if f"{name}.".startswith(f"{root.name}.")]:
        del sys.modules[name]  # those of the other folder
    spec = ModuleSpec(root.name, None, is_package=True)
    spec.submodule_search_locations = [str(root)]
    sys.modules[root.name] = module_from_spec(spec)


def _module_name(root: Path, path: Path) -> str:
    """The dotted name of a script, which begins with the root's name."""
    root, path = root.resolve(), path.resolve().with_suffix("")
    return ".".join(part.replace(".", "_") for part in (root.name, *path.relative_to(root).parts))


def forget_scripts(root: Path) -> None:
    """Unload the scripts of experiments at `root`, and the modules beside them, so that the next import loads
    them again. Other modules below `root`, such as shared ones or those of an environment, stay."""
    folders = {config.parent.resolve() for config in root.resolve().glob(f"*/{CONFIG}")}
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and Path(file).resolve().parent in folders:
            del sys.modules[name]
            package, _, last = name.rpartition(".")
            vars(sys.modules.get(package, module)).pop(last, None)  # `from package import last` looks there
    sys.path[:] = [path for path in sys.path if Path(path).resolve() not in folders]


def fingerprint_of(root: Path, path: Path, text: str, version: int) -> str:
    """A fingerprint of a script, the modules beside it and the config's version.

    It ignores what cannot change a row: the script's function `figure`, and lines that only import from gsjax
    or from the experiments, without `as`, which change when a module moves. Rows record the versions of gsjax
    and of shared modules themselves.

    Args:
        root: the folder of all experiments.
        path: path of the script.
        text: the script's source.
        version: the config's.
    """

    def moves(node: ast.AST) -> bool:
        return _only_imports(node, ("gsjax", root.resolve().name))

    beside = sorted(other for other in path.parent.glob("*.py") if other.name != path.name)
    helpers = [_without(read_script(other), moves) for other in beside]
    script = _without(text, lambda node: moves(node) or _is_figure(node))
    return hashlib.sha256("\n".join([str(version), script, *helpers]).encode()).hexdigest()[:16]


def _is_figure(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and node.name == "figure" and node.col_offset == 0


def _only_imports(node: ast.AST, packages: tuple[str, ...]) -> bool:
    """Whether a statement only imports from these packages, under the original names: with `as`, one thing
    could replace another without any change where it is used."""
    if isinstance(node, ast.Import | ast.ImportFrom) and any(alias.asname for alias in node.names):
        return False
    if isinstance(node, ast.ImportFrom):
        modules = [node.module or ""] if node.level == 0 else [""]
    else:
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [""]
    return all(module.split(".")[0] in packages for module in modules)


def _without(text: str, left_out: Callable[[ast.AST], bool]) -> str:
    """A module's text without the lines of some statements, if these stand alone on their lines."""
    try:
        nodes = [node for node in ast.walk(ast.parse(text)) if left_out(node)]
    except SyntaxError:
        return text  # loading it reports the error
    lines = text.removesuffix("\n").split("\n")  # as Python counts them; splitlines also splits at form feeds
    gone = set()
    for node in nodes:
        before = lines[node.lineno - 1].encode()[: node.col_offset]  # columns are counted in bytes
        behind = lines[node.end_lineno - 1].encode()[node.end_col_offset :].strip()
        if not before.strip() and behind[:1] in (b"", b"#"):
            gone.update(range(node.lineno - 1, node.end_lineno))
    return "\n".join(line for n, line in enumerate(lines) if n not in gone)


def made_with_of(root: Path) -> str:
    """Version of gsjax, and a hash of its sources and of shared modules. If the rows of a table come from
    several versions, a remark says so."""
    return f"{import_module('gsjax').__version__}+{_hash_of(root.resolve())}"


@cache
def _hash_of(root: Path) -> str:
    """Hash of gsjax's files, of those at the root of the experiments and of the shared ones, at the first
    call."""
    package = Path(import_module("gsjax").__file__).parent
    paths = sorted(package.rglob("*.py")) + sorted(root.glob("*.py")) + sorted((root / SHARED).rglob("*.py"))
    return hashlib.sha256(b"\n".join(path.read_bytes() for path in paths)).hexdigest()[:8]
