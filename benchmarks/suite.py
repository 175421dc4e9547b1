"""Runs the workloads, prints progress, and saves the results after each one."""

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from benchmarks.floors import TILE, Floors, measure_floors
from benchmarks.growth import draw_growth, write_growth
from benchmarks.measure import measure
from benchmarks.metrics import FAILING, Metric, compare, make_record, merged
from benchmarks.pages import LEGEND, STEP_COLUMNS, bottom_line, markdown, print_comparison, print_rows
from benchmarks.programs import BACKWARD, FORWARD, JVP
from benchmarks.steps import STEPS, measure_step
from benchmarks.workloads import QUICK, SUITE, Workload, choose
from gsjax.engine import machine
from gsjax.engine.bench import Options
from gsjax.io.atomic import atomic_write, write_json

RESULTS = Path(__file__).parent / "results"
PART = Path("runs/bench")
REPEATS, QUICK_REPEATS = 15, 5
FLAT_FROM = 10**6  # pixel pairs; smaller calls are dominated by overhead


class Run:
    """Results of a run so far, and the folder in which they are saved."""

    def __init__(self, out: Path, complete: bool, repeats: int):
        self.out, self.complete, self.repeats = out, complete, repeats
        self.rows: list[dict[str, Any]] = []
        self.steps: list[dict[str, Any]] = []
        self.metrics: list[Metric] = []
        self.floors: dict[str, list[Floors]] = {}
        self.notes: list[str] = []
        self.sweeps: dict[str, tuple[str, ...]] = {}

    def record(self, finished: bool) -> dict[str, Any]:
        """All results, in the form of bench.json."""
        flat, complete = flatness(self.rows), self.complete and finished
        metrics = list(self.metrics)
        if complete:  # for a part of the suite the figure would not be comparable
            noisy = any(row["noisy"] for row in self.rows)
            for program, found in flat.items():
                metrics.append(Metric(f"flatness/{program}", found["ratio"], "x", "lower", 0.2, True, noisy))
        return make_record(
            metrics,
            rows=self.rows,
            steps=self.steps,
            flatness=flat,
            floors={name: [f._asdict() for f in found] for name, found in self.floors.items()},
            notes=self.notes,
            complete=complete,
            repeats=self.repeats,
        )

    def write(self, finished: bool = False) -> dict[str, Any]:
        """Write bench.json, results.md and growth.png, each atomically."""
        record, drawing = self.record(finished), draw_growth(self.rows, self.sweeps)
        write_sorted(self.out / "bench.json", record)
        if drawing is not None:
            write_growth(drawing, self.out / "growth.png")
        page = markdown({**record, "has_figure": drawing is not None}, machine.in_words(machine.describe()))
        with atomic_write(self.out / "results.md") as temporary:
            temporary.write_text(page, encoding="utf-8")
        return record


def flatness(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Cost per rectangle pixel pair, largest over smallest, of large calls with colours only, by program."""
    found = {}
    for program in (FORWARD, BACKWARD, JVP):
        large = [
            row
            for row in rows
            if row["program"] == program
            and row["channels"] == 3
            and row["rectangle_pairs"] * TILE * TILE >= FLAT_FROM
        ]
        large.sort(key=lambda row: row["ns_per_rectangle_pixel"])
        if len(large) > 1:
            cheapest, dearest = large[0], large[-1]
            found[program] = {
                "ratio": dearest["ns_per_rectangle_pixel"] / cheapest["ns_per_rectangle_pixel"],
                "cheapest": cheapest["workload"],
                "dearest": dearest["workload"],
            }
    return found


def write_sorted(path: Path, record: dict[str, Any]) -> None:
    """Write JSON with sorted keys, so that two records can be compared line by line."""
    write_json(path, json.loads(json.dumps(record, sort_keys=True)))


def baseline_path(device: str) -> Path:
    """The baseline of a kind of device; ratios are not comparable between CPU and GPU."""
    return RESULTS / ("baseline.json" if device == "cpu" else "baseline-gpu.json")


def read_baseline(path: Path) -> dict[str, Any] | None:
    """The committed baseline, or None.

    Raises:
        ValueError: it is not valid JSON.
    """
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path}: expected a baseline as JSON, found {error}; restore it from git"
        ) from error


def run(options: Options, suite: list[Workload] | None = None) -> int:
    """Run the suite, or the workloads of `suite` in its place, and return the exit code.

    Raises:
        ValueError: an option is invalid, or the baseline does not fit.
    """
    suite = (QUICK if options.quick else SUITE) if suite is None else suite
    known = {workload.name: workload for workload in suite}
    chosen = choose([*known, *STEPS], options.only)
    default = QUICK_REPEATS if options.quick else REPEATS
    repeats = default if options.repeats is None else options.repeats
    if repeats < 1:
        raise ValueError(f"--repeats: expected 1 or more, found {repeats}")
    complete = not options.quick and not options.only
    path = baseline_path(machine.describe()["device"])
    baseline = read_baseline(path)
    if options.check and baseline is None:
        raise ValueError(
            f"--check: expected a baseline at {path}, found none; make one with --update-baseline"
        )
    out = options.out or (RESULTS if complete else PART)
    # Outside a terminal lines are not wrapped, so that other programs can parse them.
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 200)
    console.print(f"{machine.in_words(machine.describe())}; up to {repeats} calls each")
    console.print(LEGEND, soft_wrap=not console.is_terminal)
    found, finished = Run(out, complete, repeats), False
    try:
        _run_all(chosen, known, repeats, found, console)
        finished = True
    except KeyboardInterrupt:
        console.print("[bold red]stopped[/] by Ctrl-C; the results so far are saved")
    record = found.write(finished)
    console.print("")
    for line in bottom_line(record):
        console.print(line.replace("**", ""), markup=False)
    code = 0 if finished else 130
    if not record["metrics"] and (options.check or options.update_baseline):
        raise ValueError("--check and --update-baseline: expected measured figures, found none")
    if baseline is not None and record["metrics"]:
        rows = compare(record, baseline)
        print_comparison(console, rows, baseline)
        if options.check and finished:
            if all(row.verdict == "new" for row in rows):
                raise ValueError(
                    f"--check: expected the measured figures in {path}, found none; omit --quick or --only"
                )
            code = int(any(row.verdict in FAILING for row in rows))
    if options.update_baseline and finished:
        write_sorted(path, merged(record, baseline))
        console.print(Text.assemble(("baseline", "bold"), f"  {path}"), soft_wrap=True)
    console.print(Text.assemble(("results", "bold"), f"   {out / 'results.md'}"), soft_wrap=True)
    return code


def _run_all(
    chosen: list[str], known: dict[str, Workload], repeats: int, found: Run, console: Console
) -> None:
    """Measure the chosen workloads in order, and print and save the results after each."""
    floors = None
    with console.status("") as status:
        for name in chosen:
            status.update(name)
            if name in known:
                first = not found.rows
                try:
                    result = measure(known[name], repeats, say=status.update)
                except FileNotFoundError as error:
                    found.notes.append(f"{name}: skipped, {error}")
                    console.print(Text.assemble((f"{name}: skipped", "yellow"), f", {error}"), soft_wrap=True)
                    continue
                rows = result.as_rows()
                found.rows += rows
                found.metrics += result.metrics()
                found.notes += result.notes
                found.floors[name] = list(result.floors)
                found.sweeps[name] = known[name].sweeps
                print_rows(console, rows, head=first)
                for note in result.notes:
                    console.print(Text(note, "yellow"), soft_wrap=True)
            else:
                before = floors or measure_floors()
                row, floors = measure_step(name, repeats, before)
                found.metrics += row.metrics()
                found.floors[name] = [before, floors]
                print_rows(console, [row.as_dict()], STEP_COLUMNS, head=not found.steps)
                found.steps.append(row.as_dict())
            found.write()
