"""Output of a run: rows of a table while it runs, and results.md."""

from typing import Any

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from benchmarks.floors import CALM, TILE
from benchmarks.metrics import Row
from benchmarks.programs import BACKWARD, FORWARD, PERTURBATION

# heading, width in a terminal, cell
COLUMNS = (
    ("workload", 27, lambda r: r["workload"]),
    ("program", 28, lambda r: r["program"] + (" (noisy)" if r["noisy"] else "")),
    ("ms", 8, lambda r: figure(r["median_ms"])),
    ("p95", 8, lambda r: figure(r["p95_ms"])),
    ("/ exp", 7, lambda r: figure(r["exp_floors"])),
    ("/ copy", 7, lambda r: figure(r["copy_floors"])),
    ("compile s", 9, lambda r: figure(r["compile_s"])),
    ("GiB", 7, lambda r: figure(r["memory_gib"])),
    ("pairs", 11, lambda r: f"{r['pairs']:,}"),
    ("pixel pairs", 13, lambda r: f"{r['pixel_pairs']:,}"),
    ("ns/pixel", 8, lambda r: figure(r["ns_per_rectangle_pixel"])),
)
STEP_COLUMNS = (
    ("step", 24, lambda r: r["name"] + (" (noisy)" if r["noisy"] else "")),
    ("of", 44, lambda r: r["what"]),
    ("steps/s", 8, lambda r: figure(r["steps_per_s"])),
    ("ms", 8, lambda r: figure(r["median_ms"])),
    ("p95", 8, lambda r: figure(r["p95_ms"])),
    ("compile s", 9, lambda r: figure(r["compile_s"])),
)
LEGEND = (
    "/ exp, / copy: multiples of two lower bounds measured here and now: the time of exp for all pixels of "
    f"the Gaussians' {TILE}x{TILE} tiles, and of copying inputs and outputs once; ns/pixel: per such pixel"
)
TEXT = ("workload", "program", "step", "of")
GOALS = {FORWARD: 2, BACKWARD: 5}  # exp floors, garden, camera 0
FLAT_GOAL, MEMORY_GOAL = 1.5, 6


def figure(value: float | None) -> str:
    """A number with three significant digits, without exponents."""
    if value is None:
        return "–"
    if value != 0 and abs(value) < 100:
        digits = 2 if abs(value) < 10 else 1
        return f"{value:.{digits}f}" if abs(value) >= 0.1 else f"{value:.2g}"
    return f"{value:,.0f}"


def print_rows(console: Console, rows: list[dict[str, Any]], columns=COLUMNS, head: bool = False) -> None:
    """Print rows in columns of fixed width, so that those of later workloads are aligned with them."""
    grid = Grid.grid(padding=(0, 1, 0, 0))
    for name, width, _ in columns:
        right = "left" if name in TEXT else "right"
        width = max(width, len(name))
        grid.add_column(min_width=width, justify=right, no_wrap=True)
    if head:
        grid.add_row(*(Text(name, "bold") for name, _, _ in columns))
    for row in rows:
        style = "yellow" if row["noisy"] else ""
        grid.add_row(*(Text(cell(row), style) for _, _, cell in columns))
    console.print(grid, soft_wrap=not console.is_terminal)


def print_comparison(console: Console, rows: list[Row], baseline: dict[str, Any]) -> None:
    """Print what changed, and how many figures did not."""
    counts = {v: sum(r.verdict == v for r in rows) for v in dict.fromkeys(r.verdict for r in rows)}
    summary = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    origin = f"{baseline['date']} ({baseline['machine_name']})"
    console.print(f"\n[bold]compared with the baseline[/] of {origin}: {summary}")
    for row in rows:
        if row.verdict in ("better", "worse", "missing"):
            style = {"better": "green"}.get(row.verdict, "bold red")
            change = "" if row.change is None else f" ({row.change:+.1%})"
            line = f"  {row.key}: {figure(row.baseline)} -> {figure(row.value)} {row.unit}{change}"
            console.print(Text.assemble((f"{row.verdict:>7}", style), line), soft_wrap=True)


def markdown(record: dict[str, Any], device: str) -> str:
    """The results page: summary, method, tables, counter-cases, and which workloads were noisy."""
    rows, steps = record["rows"], record["steps"]
    parts = ["# Benchmarks", *(f"- {line}" for line in bottom_line(record)), "", METHOD.strip(), ""]
    parts += [f"{device}. Commit {record['commit'] or 'unknown'}, {record['date']} UTC."]
    if record["has_figure"]:
        parts += ["", "![Growth of time](growth.png)"]
    if rows:
        parts += ["", "## Rasterizer", "", _table(rows, COLUMNS)]
    if steps:
        parts += ["", "## Update rates", "", _table(steps, STEP_COLUMNS)]
    parts += ["", "## Counter-cases", "", *(f"- {line}" for line in counter_cases(rows))]
    noisy = sorted({r["workload"] for r in rows if r["noisy"]} | {r["name"] for r in steps if r["noisy"]})
    quiet = "None: every floor stayed within its bounds."
    line = f"Still noisy after all repetitions (hollow in the plot): {', '.join(noisy)}." if noisy else quiet
    parts += ["", "## Noise", "", line]
    if record["notes"]:
        parts += ["", "## Not measured", "", *(f"- {note}" for note in record["notes"])]
    return "\n".join(parts) + "\n"


def bottom_line(record: dict[str, Any]) -> list[str]:
    """One line per goal, with the figure reached."""
    rows, lines = record["rows"], []
    by_name = {(r["workload"], r["program"]): r for r in rows}
    for program, goal in GOALS.items():
        if row := by_name.get(("garden-0", program)):
            plain = by_name.get(("garden-0", f"{program}, plain jit"))
            also = f"; under a plain `jax.jit` {figure(plain['exp_floors'])}" if plain else ""
            lines.append(
                f"**Garden, camera 0, {program}: {figure(row['exp_floors'])} exp floors** "
                f"({figure(row['median_ms'])} ms; goal {goal}){also}."
            )
    for program, flat in record["flatness"].items():
        lines.append(
            f"Flatness, {program}: the costliest pixel pair takes {figure(flat['ratio'])} times as long as "
            f"the cheapest (goal {FLAT_GOAL}; {flat['dearest']} against {flat['cheapest']})."
        )
    wide = [r for r in rows if r["channels"] == 512 and r["program"] == BACKWARD]
    lines += [
        f"512 channels, {r['workload']}, {BACKWARD}: {figure(r['memory_gib'])} GiB (goal {MEMORY_GOAL}), "
        f"{figure(r.get('product_floors'))} times its matrix products."
        for r in wide
    ]
    rates = ((r["name"].removeprefix("steps-"), figure(r["steps_per_s"])) for r in record["steps"])
    lines += [f"{name}: {rate} steps per second." for name, rate in rates]
    if not record["complete"]:
        lines.append("Only a part of the suite was run.")
    return lines


def counter_cases(rows: list[dict[str, Any]]) -> list[str]:
    """Workloads on which the rasterizer is farthest from its floor, or an optimisation does not pay off."""
    lines = []
    for program in GOALS:
        mine = sorted((r for r in rows if r["program"] == program), key=lambda r: -r["exp_floors"])
        for row in mine[:2]:
            lines.append(
                f"{row['workload']}, {program}: {figure(row['exp_floors'])} exp floors "
                f"({figure(row['median_ms'])} ms for {row['rectangle_pairs']:,} rectangle pairs)."
            )
    by_name = {(r["workload"], r["program"]): r for r in rows}
    for (workload, program), row in by_name.items():
        unread = by_name.get((workload, f"{program}, no reads"))
        if unread and unread["median_ms"] < row["median_ms"]:
            saved = f"{figure(unread['median_ms'])} ms without, {figure(row['median_ms'])} ms with"
            lines.append(f"{workload}, {program}: `reads` does not pay off here ({saved}).")
    return lines or ["Too little was measured to tell."]


def _table(rows: list[dict[str, Any]], columns) -> str:
    heads = [name for name, _, _ in columns]
    rule = ["---" if name in TEXT else "---:" for name in heads]
    lines = [heads, rule, *([cell(row) for _, _, cell in columns] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


METHOD = f"""
## Method

Whole calls are timed: projection, binning and compositing, with a given plan; compilation is timed
separately. Means and camera are perturbed (by {PERTURBATION:g}, relative) and differ from call to call; the
`reads` of each call are passed to the next. Timing waits for the results, after two warm-up calls; *ms* is
the median, *p95* the 95th percentile.

- **forward**: colours, alphas and features. **forward+backward**: the gradient of sum(colors^2) + sum(alphas)
  (+ sum(features^2)) with respect to means, quats, scales, opacities, colors (and features). **jvp**: the
  images, and their derivative along one of the six tangents of the camera's pose, in turn. Channels beyond 3
  are features in addition to the colours. **projection**, **projection+binning**: the first stages of forward
  by themselves; compositing is the rest.
- **plain jit**: compiled by a plain `jax.jit`, without `host_options()`. **no reads**: without the `reads` of
  the previous call. The process keeps freed memory (`keep_freed_memory()`), as every command does.
- **/ exp**: multiple of the time of exp alone over all pixels of the rectangle pairs. Rectangle pairs are the
  {TILE}x{TILE} tiles in the bounding boxes of the visible Gaussians: they are a property of the scene, not of
  the rasterizer. exp is in float32, on blocks of 4 MB that stay in cache, on all cores.
- **/ copy**: multiple of the time to copy the bytes of the program's arguments and outputs, at the bandwidth
  of a copy of 256 MB.
- **GiB**: arguments, outputs and temporaries, as laid out by the compiler. **pairs**: Gaussian-tile pairs
  drawn; **pixel pairs**: these times the pixels of a tile. **ns/pixel**: median time over rectangle
  pairs x {TILE * TILE}.
- Both floors are measured right before and right after a workload's calls. If exp differs by more than
  {CALM - 1:.0%}, the workload is measured again, up to twice, and marked *noisy* if it still does.
"""
