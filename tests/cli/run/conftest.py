"""Another process that writes into a folder."""

import subprocess
import sys

import pytest

WRITES = """
import sys
from pathlib import Path
from gsjax.engine.locks import locked
with locked(Path(sys.argv[1]), sys.argv[2], shared=sys.argv[3] == "True"):
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def written():
    """Starts a process that locks a folder, or a part of it, until it is killed or its stdin is closed."""
    started = []

    def start(folder, part: str = "", *, shared: bool = False) -> subprocess.Popen:
        command = [sys.executable, "-c", WRITES, str(folder), part, str(shared)]
        started.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        assert started[-1].stdout.readline() == "locked\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()
