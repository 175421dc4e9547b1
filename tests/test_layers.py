"""The imports of the package respect its layers, which docs/architecture.md explains."""

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "gsjax"
SHORT = ("gsjax", "tests", "benchmarks")
BELOW_COMMANDS = ("experiments", "benchmarks")
"""Folders whose files build on the engine and the layers below it, as commands do."""
MAX_LINES = 400

STACK = ("geometry", "rasterize", "scene", "losses", "optim", "methods")  # each may import those before it
BESIDE = {
    "perception": {"geometry"},
    "metrics": {"geometry"},
    "data": {"geometry", "scene", "io"},
    "io": {"scene"},
    "viz": {"geometry", "scene"},
}
ALLOWED = {layer: set(STACK[:i]) for i, layer in enumerate(STACK)} | BESIDE
ANYWHERE = {"extras"}  # the one module that belongs to no layer
ALLOWED["optim"] |= {"io"}  # keeps traces on disk
ALLOWED["engine"] = {*STACK, *BESIDE}
ALLOWED["cli"] = {*STACK, *BESIDE, "engine"}


def imported_modules(file: Path, root: Path) -> Iterator[tuple[int, str]]:
    """Yields (line, dotted name) of every import in `file`, those inside functions included.

    Relative imports are resolved. `from package import name` yields `package.name`: whether that is a module
    or not, its layer is the same.
    """
    package = (root.name, *file.relative_to(root).parent.parts)
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else ()
            prefix = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{prefix}.{alias.name}") for alias in node.names)


def violations(root: Path) -> list[str]:
    """One message for each import under the package folder `root` that its layer does not allow."""
    messages = []
    for file in sorted(root.rglob("*.py")):
        where = file.relative_to(root)
        if len(where.parts) == 1:  # the package's own __init__.py and __main__.py may import any layer
            continue
        layer = where.parts[0]
        if layer not in ALLOWED:
            messages.append(f"{root.name}/{where}: {layer!r} is not a layer; those are {', '.join(ALLOWED)}")
            continue
        for line, module in imported_modules(file, root):
            top, *rest = module.split(".")
            if top != root.name or (rest and rest[0] in ALLOWED[layer] | {layer, *ANYWHERE}):
                continue
            allowed = ", ".join(sorted(ALLOWED[layer])) or "nothing"
            rule = f"{layer} may import only itself and: {allowed}"
            messages.append(f"{root.name}/{where}:{line} imports {module}, but {rule}")
    return messages


def leaning_on_commands(root: Path) -> list[str]:
    """One message for each import of `gsjax.cli` and each use of `sys.path` in the files under `root`."""
    messages = []
    for file in sorted(root.rglob("*.py")):
        where, tree = f"{root.name}/{file.relative_to(root)}", ast.parse(file.read_text(encoding="utf-8"))
        imports = list(imported_modules(file, root))
        messages += [
            f"{where}:{line} imports {module}, but commands are run as processes or by gsjax.engine"
            for line, module in imports
            if module == "gsjax.cli" or module.startswith("gsjax.cli.")
        ]
        lines = [line for line, module in imports if module == "sys.path"]
        lines += [node.lineno for node in ast.walk(tree) if ast.unparse(node) == "sys.path"]
        messages += [
            f"{where}:{line} uses sys.path, but modules are named from the repository root"
            for line in sorted(set(lines))
        ]
    return messages


def overlong(root: Path) -> list[str]:
    """One message for each file under `root` with more than `MAX_LINES` lines."""
    counts = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in sorted(root.rglob("*.py"))}
    return [
        f"{root.name}/{file.relative_to(root)} has {count} lines, {MAX_LINES} are allowed: make it a folder"
        for file, count in counts.items()
        if count > MAX_LINES
    ]


def test_files_import_only_from_layers_above_their_own():
    assert not violations(PACKAGE), "\n" + "\n".join(violations(PACKAGE))


@pytest.mark.thorough
@pytest.mark.parametrize("folder", BELOW_COMMANDS)
def test_experiments_and_benchmarks_stand_on_the_engine(folder):
    assert not leaning_on_commands(ROOT / folder), "\n" + "\n".join(leaning_on_commands(ROOT / folder))


@pytest.mark.parametrize("folder", BELOW_COMMANDS)
def test_what_experiments_and_benchmarks_import_exists(folder):
    """Few of them run in a test, so a broken import would go unnoticed until they are next needed."""

    def exists(module: str, name: str) -> bool:
        try:
            return hasattr(import_module(module), name) or bool(import_module(f"{module}.{name}"))
        except ModuleNotFoundError:
            return False

    imports = {
        (node.module, alias.name)
        for file in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE.name
        for alias in node.names
    }
    missing = [f"{module}.{name}" for module, name in sorted(imports) if not exists(module, name)]
    assert imports
    assert not missing


@pytest.mark.parametrize("folder", SHORT)
def test_files_stay_short(folder):
    assert not overlong(ROOT / folder), "\n" + "\n".join(overlong(ROOT / folder))


@pytest.fixture
def toy(tmp_path):
    """Returns a function that writes one file of a toy package named gsjax and returns the faults found."""

    def check(path: str, source: str) -> list[str]:
        file = tmp_path / "gsjax" / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(source)
        return violations(tmp_path / "gsjax") + overlong(tmp_path / "gsjax")

    return check


@pytest.mark.parametrize(
    ("path", "source"),
    [
        ("rasterize/plan.py", "from gsjax.geometry import cameras\nimport numpy as np"),
        ("rasterize/plan.py", "from .binning import sort\nfrom ..geometry.cameras import Camera"),
        ("data/panoptic.py", "def f():\n    import gsjax.scene.gaussians"),
        ("cli/report.py", "from gsjax.methods import track\nfrom gsjax.viz import plots"),
        ("__init__.py", "from gsjax.methods import track"),
    ],
)
def test_what_is_allowed_passes(toy, path, source):
    assert toy(path, source) == []


@pytest.mark.parametrize(
    ("path", "source", "says"),
    [
        ("rasterize/plan.py", "from gsjax.scene import gaussians", "rasterize/plan.py:1 imports gsjax.scene"),
        ("rasterize/plan.py", "def f():\n    import gsjax.methods.x", "plan.py:2 imports gsjax.methods.x"),
        ("geometry/sub/a.py", "from ...scene import b", "geometry/sub/a.py:1 imports gsjax.scene.b"),
        ("scene/render.py", "from .. import io", "imports gsjax.io"),
        ("scene/render.py", "import gsjax", "imports gsjax, but scene may import only itself and: geometry"),
        ("metrics/image.py", "from gsjax import scene", "metrics may import only itself and: geometry"),
        ("geometry/a.py", "from gsjax.rasterize import plan", "may import only itself and: nothing"),
        ("utils/a.py", "x = 1", "'utils' is not a layer"),
        ("scene/long.py", "x = 1\n" * (MAX_LINES + 1), "scene/long.py has 401 lines"),
    ],
)
def test_what_is_not_allowed_is_named(toy, path, source, says):
    (message,) = toy(path, source)
    assert says in message


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("from gsjax.engine.fit.run import run\nimport sys", []),
        ("import sys\nprint(sys.argv, 'sys.path')", []),
        ("def f():\n    from gsjax import cli", ["experiments/fit/fit.py:2 imports gsjax.cli"]),
        ("from gsjax.cli.fit import run", ["experiments/fit/fit.py:1 imports gsjax.cli.fit.run"]),
        ("import sys\nsys.path.insert(0, '..')", ["experiments/fit/fit.py:2 uses sys.path"]),
        ("from sys import path", ["experiments/fit/fit.py:1 uses sys.path"]),
    ],
)
def test_an_experiment_that_leans_on_commands_is_named(tmp_path, source, says):
    file = tmp_path / "experiments/fit/fit.py"
    file.parent.mkdir(parents=True)
    file.write_text(source)
    found = leaning_on_commands(tmp_path / "experiments")
    assert [message.split(", but")[0] for message in found] == says
