"""`python -m benchmarks` is `gsjax bench`."""

import sys

from gsjax.engine.interrupts import handled_interrupts
from gsjax.engine.program import run_command
from gsjax.engine.streams import say_error


def main() -> int:
    """Run the suite with the process's arguments; returns the exit code, as `gsjax bench` does."""
    does = "measure the rasterizer and every method's step here"
    try:
        with handled_interrupts():
            return run_command("bench", sys.argv[1:], ("gsjax.engine.bench", does))
    except KeyboardInterrupt:
        say_error("by Ctrl-C; what is on disk stays", word="stopped")
        return 130


if __name__ == "__main__":
    sys.exit(main())
