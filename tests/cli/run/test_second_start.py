"""What is compiled once is found by the next process."""

import json
import os
import subprocess
import sys
from time import time

SCENE = "simulated:tabletop?width=32&height=24&frames=1"
FIT = ("--fit.steps", "6", "--fit.cap", "60", "--fit.start.count", "50", "--fit.growth.begin", "2")


def start(tmp_path, name):
    """The record of a fit in a new process."""
    record, out = tmp_path / f"{name}.json", str(tmp_path / name)
    watched = [sys.executable, "-m", "benchmarks.starts", "--watch", str(record), str(time())]
    command = [*watched, "fit", SCENE, "--out", out, *FIT, "--fit.growth.every", "2"]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "xla")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(record.read_text())


def test_a_second_process_compiles_nothing(tmp_path):
    first, second = start(tmp_path, "first"), start(tmp_path, "second")
    assert first["programs"] - first["cache_hits"] > 10  # there was something to compile
    assert second["programs"] == second["cache_hits"] > 10
    assert second["updates"] == 6
