"""Commands of gsjax as a user runs them: each in its own process."""

import os
import subprocess
import sys
from typing import NamedTuple


class Ran(NamedTuple):
    """A command that has ended.

    Attributes:
        code: its exit code.
        output: what it printed, on either stream.
        memory_mb: the most memory that its process held, MB.
    """

    code: int
    output: str
    memory_mb: float


def ended(*words: object) -> Ran:
    """`gsjax WORDS...`, whatever its exit code.

    Args:
        words: the command's name, then its arguments, each of which is converted to text.
    """
    command = [sys.executable, "-m", "gsjax.cli", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)  # reports the memory of this process alone
        process.returncode = os.waitstatus_to_exitcode(status)
    except BaseException:
        process.kill()
        raise
    return Ran(process.returncode, output, usage.ru_maxrss / 1e3)


def succeeded(*words: object) -> Ran:
    """`gsjax WORDS...`, which has to succeed.

    Args:
        words: as for `ended`.

    Raises:
        RuntimeError: its exit code is not 0; what it printed is in the message.
    """
    ran = ended(*words)
    if ran.code:
        raise RuntimeError(f"gsjax {words[0]}: expected exit code 0, found {ran.code}: {ran.output}")
    return ran
