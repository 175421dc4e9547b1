"""The benchmark suite of a checkout, as `gsjax bench` and `python -m benchmarks` run it."""

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
    """Only these workloads: a name, its part before the first hyphen (garden), or a pattern (ball-1e6*)."""
    quick: bool = False
    """Small scenes, a few calls of each: under two minutes."""
    repeats: int | None = None
    """Timed calls of each program. 15 unless given, and 5 with --quick."""
    check: bool = False
    """Exit with 1 if a figure is worse than the baseline by more than its tolerance."""
    update_baseline: bool = False
    """Make what was measured the baseline."""
    out: Path | None = None
    """Folder for bench.json, results.md and growth.png. benchmarks/results for the whole suite, which is
    committed, and runs/bench for a part of it."""


def run(options: Options) -> int:
    """Run the suite; returns the exit code: 1 if --check found something worse, 130 after Ctrl-C.

    Raises:
        ValueError: this is no checkout of gsjax, or what was asked cannot be done.
    """
    if not SUITE.is_file():
        raise ValueError(
            f"gsjax bench: expected {SUITE} in the working directory, found none in {Path.cwd()}. The suite "
            "is part of the source, not of the installed package: go to a checkout of gsjax and call it there"
        )
    folder = str(Path.cwd())
    if folder not in sys.path:  # a console script does not look where it is called
        sys.path.insert(0, folder)
    return import_module("benchmarks.suite").run(options)
