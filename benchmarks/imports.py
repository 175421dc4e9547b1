"""Time imports, each in a separate process: `python -m benchmarks.imports [REPEATS]`.

Times are also given relative to JAX's own import, so that they are comparable between machines. The first
round warms the file cache and is not counted.
"""

import statistics
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[1]
AFTER_JAX = {
    "import gsjax": "import gsjax",
    "gsjax.rasterization": "import gsjax; gsjax.rasterization",
    "gsjax.open_sequence": "import gsjax; gsjax.open_sequence",
    "every public name": "import gsjax\nfor name in gsjax.__all__: getattr(gsjax, name)",
}
_TIMED = """
from time import perf_counter
a = perf_counter()
import jax
b = perf_counter()
{program}
print(b - a, perf_counter() - b)
"""


def import_times(program: str) -> tuple[float, float]:
    """Seconds of `import jax`, and of a program after it."""
    command = [sys.executable, "-c", _TIMED.format(program=program)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    jax_seconds, seconds = map(float, done.stdout.split())
    return jax_seconds, seconds


def main(repeats: int = 7) -> None:
    """Print the median of `repeats` processes for each import.

    Raises:
        ValueError: `repeats` is below 1.
    """
    if repeats < 1:
        raise ValueError(f"REPEATS: expected 1 or more, found {repeats}")
    table = Table("after import jax", "s", "import jax, s", "ratio")
    for name, program in AFTER_JAX.items():
        times = [import_times(program) for _ in range(repeats + 1)][1:]
        jax_seconds, seconds = (statistics.median(column) for column in zip(*times, strict=True))
        table.add_row(name, f"{seconds:.3f}", f"{jax_seconds:.3f}", f"{seconds / jax_seconds:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
