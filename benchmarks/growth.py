"""Plots of time over Gaussians, pixels and channels: log-log, with the floors."""

from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from benchmarks.programs import BACKWARD, FORWARD, JVP
from gsjax.io.atomic import atomic_write

INK, FAINT, GRID = "#22262b", "#6b7280", "#e4e7eb"
COLORS = {FORWARD: "#0072b2", BACKWARD: "#d55e00", JVP: "#009e73"}
AXES = {
    "gaussians": ("Gaussians", lambda row: row["gaussians"]),
    "pixels": ("pixels", lambda row: row["width"] * row["height"]),
    "channels": ("channels", lambda row: row["channels"]),
}


def draw_growth(rows: list[dict[str, Any]], sweeps: dict[str, tuple[str, ...]]) -> Figure | None:
    """One panel for each sweep with at least two measured points; None without any.

    Args:
        rows: rows of the table.
        sweeps: for each workload, the sweeps that it belongs to.
    """
    panels = {}
    for sweep in AXES:
        mine = [r for r in rows if sweep in sweeps.get(r["workload"], ()) and r["program"] in COLORS]
        if len({r["workload"] for r in mine}) > 1:
            panels[sweep] = mine
    if not panels:
        return None
    figure = Figure(figsize=(1.2 + 4.1 * len(panels), 4.4), facecolor="white", layout="constrained")
    all_axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    for axes, (sweep, mine) in zip(all_axes, panels.items(), strict=True):
        _panel(axes, sweep, mine)
    all_axes[0].set_ylabel("ms, median of a call", color=FAINT, fontsize=10)
    handles, names = all_axes[0].get_legend_handles_labels()
    # Programs first, then floors; legends are filled column by column.
    order = sorted(range(len(names)), key=lambda i: "floor" in names[i])
    handles, names = ([a[i] for i in order] for a in (handles, names))
    look = {"frameon": False, "labelcolor": INK, "fontsize": 9.5}
    figure.legend(handles, names, loc="outside lower left", ncols=2 * len(panels) - 1, **look)
    return figure


def write_growth(figure: Figure, path: Path) -> None:
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=140)


def _panel(axes, sweep: str, rows: list[dict[str, Any]]) -> None:
    label, value = AXES[sweep]
    for program, color in COLORS.items():
        mine = sorted((r for r in rows if r["program"] == program), key=value)
        x = [value(r) for r in mine]
        axes.loglog(x, [r["median_ms"] for r in mine], "-o", color=color, ms=4, lw=1.6, label=program)
        noisy = [r for r in mine if r["noisy"]]
        axes.loglog([value(r) for r in noisy], [r["median_ms"] for r in noisy], "o", mfc="white", mec=color)
        if program == FORWARD:
            exp = [r["exp_floor_ms"] for r in mine]
            axes.loglog(x, exp, color=INK, lw=1.2, ls=(0, (5, 3)), label="exp of all rectangle pairs (floor)")
        if program == BACKWARD:
            copy = [r["copy_floor_ms"] for r in mine]
            name = "copy in and out of forward+backward (floor)"
            axes.loglog(x, copy, color=FAINT, lw=1.2, ls=(0, (1, 2)), label=name)
    fixed = [f"{r['gaussians']:,} Gaussians" for r in rows[:1] if sweep != "gaussians"]
    fixed += [f"{r['width']}x{r['height']}" for r in rows[:1] if sweep != "pixels"]
    axes.set_title(f"over {label} ({', '.join(fixed)})", loc="left", fontsize=10.5, color=INK, weight="bold")
    axes.set_xlabel(label, color=FAINT, fontsize=10)
    if sweep == "channels":  # too narrow a range for powers of ten
        axes.xaxis.set_major_locator(FixedLocator(sorted({value(r) for r in rows})))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:.0f}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=FAINT, labelsize=9, length=0, which="both")
    for side in axes.spines:
        axes.spines[side].set_visible(False)
