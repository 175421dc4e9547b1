"""Setup shared by all tests: annotations are checked at run time, and floats are float32 by default."""

import gc
import os
import signal
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

# Several workers may share one GPU, so none of them may preallocate most of its memory.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
# Most of the time is spent compiling, so compiled programs are cached on disk for both workers, the processes
# that tests start, and the next run. They are keyed by what they compute, so no change of the code is missed.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "xla"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")
# Compiling without optimisations takes a third of the time, which dominates tests of small scenes.
# `make test-all` uses XLA's own settings.
flags = "--xla_backend_optimization_level=0"
if version("jaxlib").startswith("0.10."):  # XLA aborts on unknown flags
    flags += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
os.environ.setdefault("XLA_FLAGS", flags)

# Source locations are left out of programs, since recording them slows down tracing.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

# JAX's traces are many long-lived objects; scanning them in each collection takes a tenth of it.
gc.set_threshold(100_000, 50, 50)

# Background processes of a shell ignore Ctrl-C, and processes started by tests would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

from jaxtyping import install_import_hook

# Before the first import of gsjax. The numeric tower lets an int stand for a float, as type checkers do.
# Kernels are left out: Warp compiles their source.
KERNELS = "gsjax.rasterize.kernels"
PATHS = (path.relative_to(ROOT).with_suffix("") for path in (ROOT / "gsjax").rglob("*.py"))
MODULES = [".".join(path.parts).removesuffix(".__init__") for path in PATHS]
CHECKED = [name for name in MODULES if not (name + ".").startswith(KERNELS) and not KERNELS.startswith(name)]
install_import_hook(CHECKED, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")

import hypothesis
import jax
import jaxtyping
import pytest

from gsjax.engine.machine import resident_mb
from gsjax.optim.compiler import forget_programs

hypothesis.settings.register_profile("gsjax", deadline=None, max_examples=25, derandomize=True, database=None)
hypothesis.settings.load_profile("gsjax")

MOST_MAPS, MOST_MB = 20_000, 3_000  # limits for programs compiled by earlier files
MOST_MAPS_WITHIN = 40_000  # and by earlier tests of a file


@pytest.fixture(autouse=True, scope="module")
def forget_compiled():
    """Drops the compiled programs of earlier files once they hold too much.

    They take memory and memory maps; Linux allows a process 65,530 maps, too few for all tests.
    """
    yield
    forget_programs(0 if resident_mb() > MOST_MB else MOST_MAPS)


@pytest.fixture(autouse=True)
def forget_compiled_within(request):
    """Drops them within a file too.

    Where no map is left, XLA fails, and the crash handler that pycolmap installs then waits for ever.
    """
    yield
    marks = {mark.name for mark in request.node.iter_markers()}
    if marks & {"slow", "thorough"}:
        forget_programs(MOST_MAPS_WITHIN)


@pytest.fixture
def x64():
    """Runs the test with 64-bit types; request it by `@pytest.mark.usefixtures("x64")`."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def as_users_run():
    """Disables the run-time check of annotations, as for users."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Returns the folder of recordings, which are not part of the repository; skips if it is missing.

    It is where the benchmarks look for them: `$GSJAX_DATA`, or `../shared/data` beside the checkout.
    """
    from benchmarks.workloads import data_folder

    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}: point GSJAX_DATA at the folder of tabletop_0, push_t, ...")
    return folder
