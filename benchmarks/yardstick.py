"""Digests of what every method computes: run it before and after a change that must not alter results.

    python -m benchmarks.yardstick OUT [--only NAME ...] [--optimized]    # writes OUT/yardstick.json
    python -m benchmarks.yardstick --compare BEFORE.json AFTER.json       # exits with 1 where they differ

Each case is one small, seeded command in its own process. Its record holds the list of its files, a
digest of every array in NPZ and PLY files and of the pixels of every PNG, and the content of metrics.json and
metrics.jsonl. Whatever two runs of the same program may differ by is left out: times, rates, memory, machines
and paths, and the content of videos and reports. Settings are left out too, and of sentences all but their
numbers, so options may be renamed and messages reworded: rename options in `CASES`, and compare with a record
made before.

Two records compare only where they come from the same machine, versions and compiler flags. Programs are
compiled without optimising, as in the tests, in a third of the time; `--optimized` compiles as users do.
"""

import argparse
import hashlib
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any

from benchmarks.digests import FORMAT, compare, describe_run

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Case:
    """One command.

    Attributes:
        name: name for `--only`, and of its run folder.
        arguments: arguments of `gsjax` without `--out`; "{runs}" is the folder that holds all run folders.
        needs: the name of the case whose run it reads, if any.
    """

    name: str
    arguments: tuple[str, ...]
    needs: str | None = None


def _words(*lines: str) -> tuple[str, ...]:
    return tuple(word for line in lines for word in line.split())


_TABLE = "simulated:tabletop?width=96&height=72&frames="
_PARTS = "simulated:hard_parts?case=small&amount=0.05&width=96&height=72&cameras=4"
_TISSUE = "simulated:tissue?width=64&height=52&frames=10"

_FIT = _words(
    f"fit {_TABLE}4 --test-every 4 --judge-every 30",
    "--fit.steps 90 --fit.start.count 500 --fit.sh-every 20 --fit.prune 0.02",
)
_TRACK = _words(
    f"track {_TABLE}6 --cameras 0 1 --mask-camera 1 --eval-cameras 2 --track.start.iterations 10",
)
_DISTILL = _words(
    "--distill.iterations 40 --distill.channels 8 --distill.contrast-patch 4 --distill.grid.levels 4",
    "--distill.grid.features 2 --distill.grid.hidden 16 --distill.grid.log2-entries 12",
)
_DEFORM = _words(
    f"deform {_TISSUE} --tools draw --deform.warmup 8 --deform.iterations 32 --deform.start-pixels 1.5",
    "--deform.deformation.resolution 8 --deform.channels 4",
    "--deform.graph.nodes 16 --deform.graph.neighbors 2 --deform.graph.window 1",
)

CASES = (
    Case(
        "fit-relocate",
        (*_FIT, *_words("--fit.cap 900 --fit.sh-degree 1 --fit.growth.begin 20 --fit.growth.every 10")),
    ),
    Case(
        "fit-split",
        (
            *_FIT,
            *_words(
                "--fit.strategy split --fit.exposure --fit.refine-poses --fit.coarse-until 0",
                "--fit.cap 1500 --fit.sh-degree 2 --fit.split.pull 0.0005 --fit.split.too-large 0.05",
                "--fit.split.begin 20 --fit.split.every 10 --fit.split.end 0.9 --fit.split.reset-every 50",
            ),
        ),
    ),
    Case("track-fast", (*_TRACK, *_words("--preset fast"))),
    Case("track-paper", (*_TRACK, *_words("--frames 0:4 --preset paper --track.refine.iterations 8"))),
    Case(
        "parts",
        _words(
            f"parts {_PARTS} --frames 0:16:3 --eval-cameras 3 --anchor 0",
            "--fit.steps 120 --fit.cap 1500 --fit.start.count 1500 --fit.coarse-until 0",
            "--parts.stream.iterations 20 --parts.refine.iterations 16 --parts.unify.every 2",
            "--parts.unify.least-cut 1",
            "--parts.discover.lift-iterations 6 --parts.discover.most-parts 8",
        ),
    ),
    Case("distill-grid", ("distill", "{runs}/fit-relocate", *_DISTILL), needs="fit-relocate"),
    Case(
        "distill-table",
        (
            *("distill", "{runs}/fit-relocate", *_DISTILL),
            *_words("--distill.encoding table --features closed --masks segment"),
        ),
        needs="fit-relocate",
    ),
    Case("deform-nodes", (*_DEFORM, *_words("--deform.nodes 48"))),
    Case(
        "deform-gate",
        (
            *_DEFORM,
            *_words("--deform.nodes 0 --deform.moving-share 0.5 --features none"),
            *_words("--deform.deformation.color --deform.deformation.opacity"),
        ),
    ),
    Case(
        "deform-poses",
        (
            *_DEFORM,
            *_words("--preset clin --deform.nodes 48 --deform.refine-poses --deform.warmup-frames all"),
            *_words("--deform.deformation.kind mlp"),
        ),
    ),
)
"""All commands, and the only place here that knows names of options."""


def _fast_flags() -> str:
    """Flags of XLA by which programs compile without optimising, as in tests/conftest.py."""
    flags = "--xla_backend_optimization_level=0"
    if version("jaxlib").startswith("0.10."):  # XLA aborts a process that passes an unknown flag
        flags += " --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
    return flags


def record(out: Path, only: Sequence[str] = (), optimized: bool = False) -> int:
    """Run cases into OUT/runs and write OUT/yardstick.json after each; returns the exit code.

    Args:
        out: the folder; records of other cases that it holds are kept.
        only: names of cases; default: all. Cases that they need are run too, unless their runs exist.
        optimized: compile as users do.

    Raises:
        ValueError: there is no such case.
        FileExistsError: a case has a run there already.
    """
    chosen, runs, target = _chosen(only), out / "runs", out / "yardstick.json"
    chosen = [case for case in CASES if case in chosen or _needed(case, chosen, runs)]
    there = [str(runs / case.name) for case in chosen if (runs / case.name).exists()]
    if there:
        raise FileExistsError(f"{there[0]}: expected no run yet, found one; name another folder or delete it")
    runs.mkdir(parents=True, exist_ok=True)
    env = _environment(out, optimized)
    settings = {"format": FORMAT, "made_with": _made_with(env)}
    cases = json.loads(target.read_text(encoding="utf-8"))["cases"] if target.exists() else {}
    failed, sources = False, _digest_of_sources()
    for case in chosen:
        print(f"{case.name} ...", end=" ", flush=True)
        found = _run(case, runs, env)
        failed |= found["exit_code"] != 0
        print(f"{found['seconds']:.0f} s" + (f"\n{found['error']}" if "error" in found else ""), flush=True)
        cases[case.name] = found
        if _digest_of_sources() != sources:
            print(f"{case.name}: gsjax's files changed while it ran, so it is not recorded; use a clone")
            return 1
        target.write_text(json.dumps({**settings, "cases": cases}, indent=1) + "\n", encoding="utf-8")
    return int(failed)


def _digest_of_sources() -> str:
    """A digest of the files of the package, from which each case runs."""
    files = sorted((Path(__file__).resolve().parents[1] / "gsjax").rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _chosen(only: Sequence[str]) -> list[Case]:
    known = {case.name: case for case in CASES}
    for name in only:
        if name not in known:
            raise ValueError(f"--only: expected one of {', '.join(known)}; found {name}")
    return [known[name] for name in only] or list(CASES)


def _needed(case: Case, chosen: Sequence[Case], runs: Path) -> bool:
    return any(one.needs == case.name for one in chosen) and not (runs / case.name).exists()


def _environment(out: Path, optimized: bool) -> dict[str, str]:
    """Environment of all processes: this checkout, a cache of its own for features, and XLA's flags."""
    return {
        "JAX_COMPILATION_CACHE_DIR": str((out / "programs").resolve()),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "0",
        **os.environ,
        "XDG_CACHE_HOME": str((out / "cache").resolve()),
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "120",
        "XLA_FLAGS": "" if optimized else _fast_flags(),
    }


def _made_with(env: Mapping[str, str]) -> dict[str, Any]:
    return {
        "xla_flags": env["XLA_FLAGS"],
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "processor": platform.machine(),
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy", "scipy")},
    }


def _run(case: Case, runs: Path, env: Mapping[str, str]) -> dict[str, Any]:
    """One case in a process of its own, and what is kept of it."""
    shutil.rmtree(Path(env["XDG_CACHE_HOME"]) / "gsjax", ignore_errors=True)  # features of an earlier case
    arguments = [word.replace("{runs}", str(runs.resolve())) for word in case.arguments]
    command = [sys.executable, "-m", "gsjax.cli", *arguments, "--out", str(runs.resolve() / case.name)]
    begun = perf_counter()
    done = subprocess.run(command, env=dict(env), cwd=runs, capture_output=True, text=True, check=False)
    found: dict[str, Any] = {
        "arguments": list(case.arguments),
        "seconds": perf_counter() - begun,
        "exit_code": done.returncode,
    }
    if done.returncode:
        found["error"] = (done.stdout + done.stderr)[-2000:]
    return {**found, "files": describe_run(runs / case.name)}


def print_comparison(before: Mapping[str, Any], after: Mapping[str, Any], only: Sequence[str] = ()) -> int:
    """Print `compare` case by case, of the cases `only` (default: all).

    Returns:
        1 where anything differs, else 0.
    """
    for name, value in before["made_with"].items():
        if after["made_with"].get(name) != value:
            print(f"made with another {name}: {value!r}, then {after['made_with'].get(name)!r}")
    found = compare(*({**one, "cases": _of(one["cases"], only)} for one in (before, after)))
    for name, lines in found.items():
        print(f"{name}: " + ("same to the bit" if not lines else f"{len(lines)} differences"))
        for line in lines:
            print(f"  {line}")
    return int(any(found.values()))


def _of(cases: Mapping[str, Any], only: Sequence[str]) -> dict[str, Any]:
    return {name: case for name, case in cases.items() if not only or name in only}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line of this script; returns the exit code."""
    parser = argparse.ArgumentParser("python -m benchmarks.yardstick", description=__doc__.splitlines()[0])
    parser.add_argument("out", nargs="?", type=Path, help="folder for runs and yardstick.json")
    parser.add_argument(
        "--only", nargs="+", default=(), metavar="NAME", help="cases to run, or to compare (default: all)"
    )
    parser.add_argument("--optimized", action="store_true", help="compile with XLA's own settings")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"), help="two records")
    given = parser.parse_args(arguments)
    if given.compare:
        records = [json.loads(path.read_text(encoding="utf-8")) for path in given.compare]
        return print_comparison(
            *records, only=[case.name for case in _chosen(given.only)] if given.only else ()
        )
    if given.out is None:
        parser.error("expected a folder, or --compare with two records")
    return record(given.out, given.only, given.optimized)


if __name__ == "__main__":
    sys.exit(main())
