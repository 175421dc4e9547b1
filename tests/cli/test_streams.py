"""Whatever happens to the standard streams, a command does its work, and its exit code tells how it went."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="a shell")
GSJAX = f"{sys.executable} -m gsjax.cli"
FEW = "simulated:tabletop?frames=2&width=40&height=32"


def shell(line: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        ["/bin/bash", "-c", line], capture_output=True, text=True, timeout=300, env=os.environ | environment
    )


CLOSED = "<&- >&- 2>&-"


@pytest.mark.thorough
@pytest.mark.parametrize("streams", [">&-", "2>&-", CLOSED, "1</dev/null", f"{CLOSED}; info '{FEW}'"])
def test_closed_streams_change_nothing(streams):
    streams, _, command = streams.partition("; ")
    done = shell(f"{GSJAX} {command or '--help'} {streams}")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.thorough
def test_a_reader_may_go_away():
    done = shell(f"{GSJAX} info '{FEW}' | true; echo ${{PIPESTATUS[0]}}")
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.thorough
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no disk that is always full")
def test_a_full_disk_is_told_and_ends_nothing():
    done = shell(f"{GSJAX} info '{FEW}' > /dev/full")
    said = "warning: standard output could not be written (No space left on device)\n"
    assert (done.returncode, done.stderr) == (0, said)
    assert shell(f"{GSJAX} info '{FEW}' 2> /dev/full").returncode == 0


@pytest.mark.thorough
def test_errors_keep_their_exit_code_where_nobody_hears_them():
    assert shell(f"{GSJAX} infoo 2>&-").returncode == 2
    assert shell(f"{GSJAX} info nowhere >&- 2>&-").returncode == 2


OPENS = """
import os
from gsjax.engine.streams import keep_streams_open
keep_streams_open()
os.write(9, f"{os.open(os.devnull, os.O_RDONLY)}".encode())
"""


def test_a_file_does_not_get_the_number_of_a_closed_stream():
    done = shell(f"{sys.executable} -c '{OPENS}' 9>&1 <&- >&- 2>&-")
    assert int(done.stdout) > 2


@pytest.mark.thorough
@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"COLUMNS": "20", "TERM": "dumb"},
        {"HOME": "/nowhere", "XDG_CACHE_HOME": "", "TMPDIR": "/nowhere", "PATH": ""},
    ],
)
def test_an_odd_environment_is_none_of_a_commands_business(environment, tmp_path):
    done = shell(f"{GSJAX} info '{FEW}' --picture {tmp_path / 'cameras.png'}", **environment)
    assert (done.returncode, "wide" in done.stdout) == (0, True), done.stderr
    assert (tmp_path / "cameras.png").stat().st_size > 1000
