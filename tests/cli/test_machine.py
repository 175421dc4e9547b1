"""The cores, backend and memory that a process uses, and how a machine is described."""

import os
import subprocess
import sys

import numpy as np
import pytest

from gsjax.engine.machine import (
    describe,
    in_words,
    keep_to_cores,
    missing_device,
    name,
    peak_memory_mb,
    resident_mb,
)

needs_affinity = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="this system does not let a process choose its cores"
)

KEPT = """
import os
import threading
import jax
import gsjax.cli.live
from gsjax.engine.machine import describe, keep_to_cores

before = os.sched_getaffinity(0)
done = threading.Event()
thread = threading.Thread(target=done.wait)
thread.start()
keep_to_cores(1)
there = os.sched_getaffinity(thread.native_id)
done.set()
assert there == {max(before)}
assert os.sched_getaffinity(0) == {max(before)}
cores = describe()["cores"]
jax.block_until_ready(jax.numpy.ones((500, 500)) @ jax.numpy.ones((500, 500)))
names = {t: open(f"/proc/self/task/{t}/comm").read() for t in os.listdir("/proc/self/task")}
pool = [int(t) for t, name in names.items() if "XLA" in name or "tf_" in name]
print(cores, len(pool) > 0, all(os.sched_getaffinity(t) == {max(before)} for t in pool))
"""


@pytest.mark.thorough
@needs_affinity
def test_threads_run_on_the_cores_that_are_kept_to_those_of_jax_too():
    """Importing a command must not start JAX's threads."""
    said = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["1", "True", "True"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "variable", ["JAX_PLATFORMS", pytest.param("JAX_PLATFORM_NAME", marks=pytest.mark.slow)]
)
def test_only_commands_that_compute_need_the_backend_that_is_asked_for(variable, tmp_path):
    scene, out = "simulated:tabletop?frames=2&width=40&height=32", str(tmp_path / "run")
    for command, code in ((["info", scene], 0), (["fit", scene, "--out", out], 2)):
        program = [sys.executable, "-m", "gsjax.cli", *command]
        asked = os.environ | {variable: "nonsense"}
        done = subprocess.run(program, env=asked, capture_output=True, text=True, check=False)
        assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
    assert done.stderr.startswith(f"error: {variable}=nonsense: expected a backend with a device on this")
    assert not (tmp_path / "run").exists()


def test_a_backend_without_devices_is_named(monkeypatch):
    def without():
        raise AssertionError  # as JAX does for CUDA without a GPU

    assert missing_device() is None
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    monkeypatch.setattr("jax.devices", without)
    said = (
        "JAX_PLATFORMS=cuda: expected a backend with a device on this machine, found none; leave it out, or "
    )
    assert missing_device() == f"{said}set JAX_PLATFORMS=cpu"


@needs_affinity
@pytest.mark.parametrize("count", [0, -1, 100_000])
def test_more_cores_than_there_are_is_an_error(count):
    before = os.sched_getaffinity(0)
    with pytest.raises(ValueError, match=rf"--cores: expected 1 .* found {count}"):
        keep_to_cores(count)
    assert os.sched_getaffinity(0) == before


def test_one_core_is_singular():
    machine = describe()
    assert "1 core;" in in_words(machine | {"cores": 1, "avx512": False})
    assert name(machine | {"cores": 1}).endswith(", 1 core")
    assert name(machine | {"cores": 2}).endswith(", 2 cores")


def test_none_changes_nothing(monkeypatch):
    monkeypatch.delattr(os, "sched_setaffinity", raising=False)
    keep_to_cores(None)


def test_a_system_without_a_choice_says_so(monkeypatch):
    monkeypatch.delattr(os, "sched_setaffinity", raising=False)
    with pytest.raises(ValueError, match=r"--cores 1: .* does not let a process choose its cores; leave it"):
        keep_to_cores(1)


def test_the_peak_of_memory_outlives_what_was_held():
    held = np.ones(25_000_000)  # 200 MB
    now = resident_mb()
    del held
    peak = peak_memory_mb()
    assert peak["process"] > 0.99 * now
    assert peak["process"] >= resident_mb()
    assert peak["device"] is None or peak["device"] > 0
