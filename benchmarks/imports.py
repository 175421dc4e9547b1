"""How long imports take, each in a process of its own: `python -m benchmarks.imports [REPEATS]`.

Beside JAX's own import, which nothing here can shorten: a ratio means the same on a slow machine and a fast
one. Files should be warm, so the first round is not counted.
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
    """Seconds that `import jax` takes, and a program after it."""
    command = [sys.executable, "-c", _TIMED.format(program=program)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    of_jax, beyond = map(float, done.stdout.split())
    return of_jax, beyond


def main(repeats: int = 7) -> None:
    """Print the median of `repeats` processes for each import.

    Raises:
        ValueError: nothing would be measured.
    """
    if repeats < 1:
        raise ValueError(f"REPEATS: expected 1 or more, found {repeats}")
    table = Table("after import jax", "s", "of jax's own s", "ratio")
    for name, program in AFTER_JAX.items():
        times = [import_times(program) for _ in range(repeats + 1)][1:]
        of_jax, beyond = (statistics.median(column) for column in zip(*times, strict=True))
        table.add_row(name, f"{beyond:.3f}", f"{of_jax:.3f}", f"{beyond / of_jax:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
