"""The benchmark suite of a checkout, as run by `gsjax bench` and `python -m benchmarks`."""

import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

import tyro

from gsjax.engine.options import Common

SUITE = Path("benchmarks", "suite.py")


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax bench`."""

    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME [NAME ...]")] = ()
    """Only these workloads: a name, its part before the first hyphen (garden), or a pattern (ball-1e6*). With
    --starts, only these commands."""
    starts: bool = False
    """Instead, measure how long each command takes until its first update and in total, without and with
    previously compiled programs. It takes about ten minutes."""
    quick: bool = False
    """Use small scenes and few calls of each: under two minutes."""
    repeats: int | None = None
    """Number of timed calls of each program; default: 15, or 5 with --quick."""
    check: bool = False
    """Exit with code 1 if a figure is worse than the baseline by more than its tolerance."""
    update_baseline: bool = False
    """Save the measured figures as the baseline."""
    out: Path | None = None
    """Folder for bench.json, results.md and growth.png; default: benchmarks/results, which is committed, for
    the whole suite, and runs/bench for a part of it. With --starts, for starts.json; default: runs/starts."""


def run(options: Options) -> int:
    """Run the suite; returns the exit code: 1 if --check found something worse, 130 after Ctrl-C.

    Raises:
        ValueError: the working directory is no checkout of gsjax, or an option cannot be met.
    """
    if not SUITE.is_file():
        raise ValueError(
            f"gsjax bench: expected {SUITE} in the working directory, found none in {Path.cwd()}. The suite "
            "is part of the source, not of the installed package: run it in a checkout of gsjax"
        )
    folder = str(Path.cwd())
    if folder not in sys.path:  # a console script does not search the working directory
        sys.path.insert(0, folder)
    import_module("gsjax.viz")  # then the suite can import matplotlib whatever MPLBACKEND says
    return import_module("benchmarks.starts" if options.starts else "benchmarks.suite").run(options)
