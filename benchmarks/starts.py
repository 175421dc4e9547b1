"""Start-up times: how long each command takes until its first update and in total, cold and warm, and why.

    gsjax bench --starts --only track fit

Every command runs in a process of its own: first with an empty cache of compiled programs (cold), then again
(warm). The process listens to JAX's own events, which name each program that is traced, lowered and compiled.
"""

import json
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter, time
from typing import Any
from urllib.request import urlopen

from rich.console import Console
from rich.table import Table

from gsjax.engine import machine
from gsjax.engine.bench import Options
from gsjax.engine.drive import UPDATE
from gsjax.io.atomic import write_json

_TABLE = "simulated:tabletop?width=240&height=180"
_TISSUE = "simulated:tissue?frames=8&width=160&height=128"
_STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
_HIT = "/jax/compilation_cache/cache_hits"
PART = Path("runs/starts")
_LISTED = 12  # programs in a record

COMMANDS: dict[str, tuple[str, ...]] = {
    "track": ("track", _TABLE, "--frames", "0:30", "--cameras", "0", "1", "--mask-camera", "1",
              "--eval-cameras", "2", "--track.start.iterations", "60"),
    "live": ("live", _TABLE, "--cameras", "0", "1", "--mask-camera", "1", "--minutes", "0.05"),
    "fit": ("fit", _TABLE, "--frames", "0:1", "--test-every", "0", "--fit.steps", "20"),
    "parts": ("parts", "simulated:articulated?width=160&height=120", "--frames", "0:9:4",
              "--parts.refine.iterations", "0"),
    "distill": ("distill", "{fit}", "--preset", "paper", "--distill.iterations", "10"),
    "deform": ("deform", _TISSUE, "--deform.iterations", "10"),
    "view": ("view", "{fit}"),
}  # fmt: skip
"""Each command on a small built-in scene; {fit} is the folder of the run of `fit`. The first result of `view`
is its page, after which it ends."""


def watch(record: Path, begun: float, arguments: Sequence[str]) -> int:
    """Run one command in this process, and write what JAX compiled for it.

    Args:
        record: the file to write.
        begun: when the process was started, seconds since the epoch.
        arguments: arguments of the command.
    """
    import jax

    spans: list[tuple[str, str, float, float]] = []
    updates: list[float] = []
    hits = [0]

    def ended(event: str, seconds: float, **about: Any) -> None:
        now = time() - begun
        if event in _STAGES:
            spans.append((_STAGES[event], str(about.get("fun_name", "?")), now - seconds, now))
        elif event == UPDATE:
            updates.append(now)

    def hit(event: str, **_: Any) -> None:
        hits[0] += event == _HIT

    jax.monitoring.register_event_duration_secs_listener(ended)
    jax.monitoring.register_event_listener(hit)
    ready = time() - begun
    if arguments[0] == "view":
        _end_with_its_page(lambda: updates.append(time() - begun))
    sys.argv = ["gsjax", *arguments]
    try:
        runpy.run_module("gsjax.cli", run_name="__main__")
        code = 0
    except SystemExit as left:
        code = left.code if isinstance(left.code, int) else 1
    if arguments[0] == "view" and code == 130:  # Ctrl-C is how it ends
        code = 0
    found = {"imported_s": ready, "first_s": updates[0] if updates else None, "total_s": time() - begun}
    found |= {f"{stage}_s": _union([s[2:] for s in spans if s[0] == stage]) for stage in _STAGES.values()}
    compiled = [span for span in spans if span[0] == "compiling"]
    found |= {"programs": len(compiled), "cache_hits": hits[0], "updates": len(updates)}
    write_json(record, found | {"by_program": _by_program(spans), "exit_code": code})
    return code


def _end_with_its_page(served: Callable[[], None]) -> None:
    """Make a viewer end, as by Ctrl-C, once its page can be loaded."""
    from gsjax.viz.viewer import Viewer

    def wait(viewer: Viewer) -> None:
        with urlopen(viewer.url) as page:
            page.read()
        served()
        raise KeyboardInterrupt

    Viewer.wait = wait
    os._exit = sys.exit  # the command line leaves by os._exit after Ctrl-C; the record is written later


def _union(spans: list[tuple[float, float]]) -> float:
    """Length of the union of intervals: what one program traces inside another counts once."""
    length, end = 0.0, float("-inf")
    for begin, finish in sorted(spans):
        length += max(0.0, finish - max(begin, end))
        end = max(end, finish)
    return length


def _by_program(spans: list[tuple[str, str, float, float]]) -> list[dict[str, Any]]:
    """Seconds of each stage by the name of the program, the costliest first; an inner program's tracing is
    part of the outer one's."""
    rows: dict[str, dict[str, Any]] = {}
    for stage, name, begin, end in spans:
        name = name.removeprefix("jit_").removeprefix("jit(").removesuffix(")")
        row = rows.setdefault(name, {"name": name, "count": 0, **dict.fromkeys(_STAGES.values(), 0.0)})
        row[stage] += end - begin
        row["count"] += stage == "compiling"
    compiled = [row for row in rows.values() if row["count"]]
    return sorted(compiled, key=lambda row: -sum(row[stage] for stage in _STAGES.values()))[:_LISTED]


def measure(name: str, out: Path, cache: Path, label: str) -> dict[str, Any]:
    """Run one command in a new process, and return its record."""
    fit = out / "runs" / f"fit-{label}"
    arguments = [part.format(fit=fit) for part in COMMANDS[name]]
    run, record = out / "runs" / f"{name}-{label}", out / f"{name}-{label}.json"
    words = [*arguments, *([] if name == "view" else ["--out", str(run), "--overwrite"])]
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(cache)
    command = [sys.executable, "-m", "benchmarks.starts", str(record), str(time()), *words]
    log = out / f"{name}-{label}.log"
    begun = perf_counter()
    with log.open("w", encoding="utf-8") as file:
        code = subprocess.run(command, env=environment, stdout=file, stderr=file, check=False).returncode
    if code:
        raise RuntimeError(f"gsjax {' '.join(words)} ended with code {code}; see {log}")
    return json.loads(record.read_text(encoding="utf-8")) | {"process_s": perf_counter() - begun}


def print_table(records: dict[str, dict[str, dict[str, Any]]], console: Console) -> None:
    """One line per command and start."""
    columns = ("first_s", "process_s", "imported_s", "tracing_s", "lowering_s", "compiling_s")
    table = Table("command", "start", *(c.removesuffix("_s") for c in columns), "programs", "hits", box=None)
    for name, starts in records.items():
        for label, found in starts.items():
            figures = ["–" if found[c] is None else f"{found[c]:.1f}" for c in columns]
            table.add_row(name, label, *figures, str(found["programs"]), str(found["cache_hits"]))
    console.print(table)


def run(options: Options) -> int:
    """Measure the starts of the chosen commands, and write starts.json after each.

    Raises:
        ValueError: an option does not apply, or there is no such command.
    """
    given = [name for name in ("quick", "check", "update_baseline") if getattr(options, name)]
    given += ["repeats"] if options.repeats is not None else []
    if given:
        raise ValueError(f"--{given[0].replace('_', '-')}: does not apply to --starts; leave it out")
    if unknown := [name for name in options.only if name not in COMMANDS]:
        raise ValueError(f"--only: expected commands of {', '.join(COMMANDS)}, found {unknown[0]}")
    names = [name for name in COMMANDS if name in (options.only or COMMANDS)]
    if "fit" not in names and (of_its_scene := [name for name in names if "{fit}" in COMMANDS[name]]):
        names.insert(names.index(of_its_scene[0]), "fit")
    out, console = (options.out or PART).absolute(), Console(width=None if sys.stdout.isatty() else 120)
    out.mkdir(parents=True, exist_ok=True)
    records: dict[str, dict[str, dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as cache:
        for name in names:
            records[name] = {}
            for label in ("cold", "warm"):
                records[name][label] = measure(name, out, Path(cache) / name, label)
            print_table({name: records[name]}, console)
            write_json(out / "starts.json", {"machine": machine.describe(), "starts": records})
    return 0


if __name__ == "__main__":  # `measure` starts it in a new process
    sys.exit(watch(Path(sys.argv[1]), float(sys.argv[2]), sys.argv[3:]))
