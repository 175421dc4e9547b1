"""Which modules an import loads. How long it takes is measured by `python -m benchmarks.imports`."""

import ast
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Packages of extras, which may be missing, and (LATE) packages that only some commands need.
OPTIONAL = {"viser", "torch", "transformers", "mujoco", "pycolmap", "tensorboardX", "distributed", "dask"}
OPTIONAL |= {"OpenEXR", "rosbags", "pyrealsense2"}
LATE = {"matplotlib", "skimage", "jaxopt", "imageio_ffmpeg", "rich", "tyro", "PIL"}


def loaded(program: str) -> set[str]:
    """Returns the top-level modules in `sys.modules` after a program has run in a process of its own."""
    ending = "\nimport json, sys; print(json.dumps(sorted({name.split('.')[0] for name in sys.modules})))"
    command = [sys.executable, "-c", program + ending]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=300)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_gsjax_alone_loads_nothing_else():
    assert not loaded("import gsjax") & (OPTIONAL | LATE | {"jax", "numpy", "scipy", "cv2", "equinox"})


@pytest.mark.thorough
def test_the_public_names_need_no_extra():
    found = loaded("import gsjax\nfor name in gsjax.__all__: getattr(gsjax, name)")
    assert {"jax", "equinox"} <= found
    assert not found & (OPTIONAL | LATE)


@pytest.mark.thorough
def test_the_rasterizer_needs_no_files_and_no_solver():
    found = loaded("import gsjax\ngsjax.rasterization, gsjax.Gaussians, gsjax.render")
    assert not found & (OPTIONAL | LATE | {"cv2", "optax", "optimistix"})


def test_help_does_not_wait_for_jax():
    found = loaded("from gsjax.cli import main\nassert main(['--help']) == 0")
    assert not found & (OPTIONAL | {"jax", "numpy", "scipy", "cv2", "matplotlib", "tyro"})


@pytest.mark.parametrize("command", ["track", "info", "view", "export", "poses", "distill", "experiment"])
def test_help_of_a_command_needs_no_extra(command):
    asked = f"""
from gsjax.cli import main
try:
    ended = main([{command!r}, "--help"])
except SystemExit as left:
    ended = left.code
assert not ended, ended"""
    assert not loaded(asked) & OPTIONAL


EACH = """
import importlib, socket, sys
import jax
from jax._src import xla_bridge
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except ImportError as error:  # of an extra
        if str(error.name).startswith("gsjax"):
            raise
    if xla_bridge.backends_are_initialized():
        sys.exit(f"{name} starts JAX's backend")
with socket.socket() as free:
    free.bind(("localhost", 0))
    port = free.getsockname()[1]
jax.distributed.initialize(f"localhost:{port}", 1, 0)
"""


@pytest.mark.thorough
def test_no_module_starts_the_backend_of_jax():
    """So calls that configure it, such as `jax.distributed.initialize`, may follow an import."""
    files = [file.relative_to(ROOT).with_suffix("") for file in (ROOT / "gsjax").rglob("*.py")]
    names = sorted(".".join(file.parts).removesuffix(".__init__") for file in files)
    done = subprocess.run([sys.executable, "-c", EACH, *names], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("backend", ["module://nowhere.backend_inline", "nonsense", "qtagg", "absent", "AGG"])
def test_plots_need_no_backend_of_matplotlib(backend, tmp_path):
    """A notebook passes its own backend to the programs it starts, where it may not be installed."""
    program = (
        "import os, sys\nfrom gsjax.viz import plots\nimport matplotlib\n"
        "plots.save(plots.update_time([0.1, 0.2]), sys.argv[1])\n"
        "print(os.environ['MPLBACKEND'])\nprint(matplotlib.rcParams._get('backend'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "plot.png")],
        cwd=ROOT,
        env=os.environ | {"MPLBACKEND": backend},
        capture_output=True,
        text=True,
        check=True,
    )
    there = {"qtagg", "AGG", "module://nowhere.backend_inline"}
    given, used = done.stdout.splitlines()
    assert given == backend  # unchanged, for child processes
    assert (used.lower() == backend.lower()) == (backend in there)


@pytest.mark.thorough
def test_what_is_told_to_install_is_there():
    """Each `extras.load(module, extra, ...)` names an extra that requires the module's package."""
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    calls = [
        (node.args[0], node.args[1].value)
        for file in (ROOT / "gsjax").rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "extras.load"
    ]
    sensors = {"realsense", "record3d", "rosbag"}
    others = {"cluster", "foundation", "poses", "tensorboard", "viewer"}
    assert {extra for _, extra in calls} == sensors | others
    for module, extra in calls:
        if isinstance(module, ast.Constant):
            package = module.value.partition(".")[0].replace("_", "-")
            assert any(requirement.startswith(package) for requirement in asked[extra]), (package, extra)
