"""What one process compiled or traced is reused by the next."""

import json
import os
import subprocess
import sys
from time import time

import pytest

SCENE = "simulated:tabletop?width=32&height=24&frames=1"
FIT = ("--fit.steps", "6", "--fit.cap", "60", "--fit.start.count", "50", "--fit.growth.begin", "2")


def start(tmp_path, name):
    """Runs a fit in a new process; returns its record."""
    record, out = tmp_path / f"{name}.json", str(tmp_path / name)
    watched = [sys.executable, "-m", "benchmarks.starts", str(record), str(time())]
    command = [*watched, "fit", SCENE, "--out", out, *FIT, "--fit.growth.every", "2"]
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path / "cache")
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(record.read_text())


def traces(tmp_path):
    """The inode of each cached trace, by file name: a trace that is written again has a new one."""
    return {path.name: path.stat().st_ino for path in tmp_path.glob("cache/gsjax/*/traces/*.npz")}


@pytest.mark.thorough
def test_a_second_process_compiles_nothing_and_traces_no_step(tmp_path):
    first, kept = start(tmp_path, "first"), traces(tmp_path)
    second = start(tmp_path, "second")
    assert first["programs"] - first["cache_hits"] > 10  # there was something to compile
    assert second["programs"] == second["cache_hits"] > 10
    assert second["updates"] == 6
    assert kept
    assert traces(tmp_path) == kept
