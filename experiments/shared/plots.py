"""Figures of the experiments with a robot, and of those with single updates."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, GRID = "#22262b", "#6b7280", "#e4e7eb"
BLUE, GREEN, GREY, ORANGE = "#0072b2", "#009e73", "#9aa0a8", "#d55e00"
SKY, PURPLE = "#56b4e9", "#8a5fbf"
GRASPING = {"tracker": BLUE, "true poses": GREEN, "first frame": GREY}
POLICIES = {"tracked Gaussians": BLUE, "images": ORANGE, "true poses": GREEN}

OPTIMIZERS = {
    "Adam, translation": (GREY, "s"),
    "Adam, SE(3)": ("#e9a36b", "v"),
    "Adam, SE(3), rigid": (ORANGE, "o"),
    "Levenberg-Marquardt": (PURPLE, "D"),
    "ICP": (GREEN, "^"),
    "direct alignment": (SKY, "o"),
    "direct, searched": (BLUE, "*"),
}

COSINES = {
    "cos_single": ("single Gaussians, photometric", GREY, "-"),
    "cos_photometric": ("photometric", ORANGE, "-"),
    "cos_blocks": ("photometric, means of 8 x 8 pixels", ORANGE, (0, (4, 2))),
    "cos_depth": ("photometric and depth", GREEN, "-"),
}
ARRIVALS = {
    "home_adam": ("Adam, photometric", ORANGE, "s"),
    "home_adam_depth": ("Adam, photometric and depth", GREEN, "D"),
    "home_align": ("direct alignment", SKY, "o"),
    "home_search": ("direct alignment, searched", BLUE, "*"),
}
WIDTHS = (6, 3.5, 2.5, 1.5)  # of their lines, so that those below stay visible


def wilson(successes: float, count: int) -> tuple[float, float]:
    """The 95 % interval of a rate (Wilson, JASA 1927), which keeps its width where all or none succeed."""
    z, rate = 1.96, successes / count
    middle = (rate + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    return middle - half, middle + half


def draw_grasping(rows: list[dict[str, Any]], path: Path) -> None:
    """Rates of success, and the tracker's errors as shares of trials."""
    drawing = Figure(figsize=(9.8, 3.8), facecolor="white", layout="constrained")
    left, right = drawing.subplots(1, 2, width_ratios=(1.25, 1))
    _axes(left, "Lifted by 10 cm and held", "", "share of trials")
    groups = [kind for kind in ("still", "moving") if any(row["object"] == kind for row in rows)]
    for i, (source, color) in enumerate(GRASPING.items()):
        found = [
            [r["success"] for r in rows if (r["object"], r["grasp from"]) == (g, source)] for g in groups
        ]
        _bars(left, [g + 0.27 * (i - 1) for g in range(len(groups))], found, color, source, 0.24)
    counts = [sum(r["object"] == g and r["grasp from"] == "tracker" for r in rows) for g in groups]
    names = {"still": "object lies still", "moving": "on a belt, 3 to 8 cm/s"}
    ticks = [f"{names[g]}\n{n} trials each" for g, n in zip(groups, counts, strict=True)]
    left.set_xticks(range(len(groups)), ticks, color=INK)
    left.set(ylim=(0, 1.17), yticks=np.linspace(0, 1, 6))
    left.grid(axis="x", visible=False)
    _axes(right, "The tracker, as the fingers close", "centroid error (mm)", "share of trials")
    for group, style in zip(groups, ("-", (0, (4, 2))), strict=False):
        mine = [row for row in rows if (row["object"], row["grasp from"]) == (group, "tracker")]
        errors = np.sort([row["error_before_mm"] for row in mine if row["error_before_mm"] is not None])
        shares = np.arange(1, len(errors) + 1) / max(len(errors), 1)
        right.step(errors, shares, where="post", color=BLUE, ls=style, lw=1.8, label=names[group])
    right.set(xscale="log", ylim=(0, 1.03))
    right.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    right.legend(frameon=False, fontsize=9.5, labelcolor=INK, loc="lower right")
    handles, labels = left.get_legend_handles_labels()
    style = {"frameon": False, "fontsize": 9.5, "labelcolor": INK, "columnspacing": 1.4, "handlelength": 1.1}
    titles = [
        f"grasp from {label}" if label != "first frame" else "first frame's, no updates" for label in labels
    ]
    drawing.legend(handles, titles, loc="outside lower left", ncols=3, **style)
    drawing.savefig(path, dpi=160)


def draw_policies(rows: list[dict[str, Any]], path: Path) -> None:
    """Rates of success: a bar of all rollouts, and a dot for each training seed."""
    drawing = Figure(figsize=(6.4, 3.7), facecolor="white", layout="constrained")
    axes = drawing.subplots()
    _axes(axes, "A can put into its bin", "", "share of rollouts")
    kinds = [kind for kind in POLICIES if any(row["sees"] == kind for row in rows)]
    ticks = []
    for place, kind in enumerate(kinds):
        mine = [row for row in rows if row["sees"] == kind]
        seeds = sorted({row["trained"] for row in mine})
        _bars(axes, [place], [[row["success"] for row in mine]], POLICIES[kind], None, 0.5)
        for i, seed in enumerate(seeds):
            rate = np.mean([row["success"] for row in mine if row["trained"] == seed])
            at = place + 0.1 * (i - (len(seeds) - 1) / 2)
            axes.plot(at, rate, "o", ms=6, mfc="white", mec=INK, mew=1.2, zorder=4, clip_on=False)
        plural = "" if len(seeds) == 1 else "s"
        ticks.append(f"{kind}\n{len(mine)} rollouts,\n{len(seeds)} training seed{plural}")
    axes.set_xticks(range(len(kinds)), ticks, color=INK)
    axes.set(ylim=(0, 1.17), yticks=np.linspace(0, 1, 6), xlim=(-0.5, len(kinds) - 0.5))
    axes.grid(axis="x", visible=False)
    drawing.savefig(path, dpi=160)


def draw_optimizers(rows: list[dict[str, Any]], path: Path) -> None:
    """Point error over time, a panel for each kind of update."""
    drawing = Figure(figsize=(11.5, 7.6), facecolor="white", layout="constrained")
    kinds = list(dict.fromkeys((row["recording"], row["gap"]) for row in rows))
    grid = drawing.subplots(2, -(-len(kinds) // 2), squeeze=False, sharex=True, sharey=True)
    for axes, (recording, gap) in zip(grid.flat, kinds, strict=False):
        mine = [row for row in rows if (row["recording"], row["gap"]) == (recording, gap)]
        away = f"{gap} frame" + "s" * (gap > 1)
        _axes(axes, f"{recording}, {away} on", "", "")
        axes.axhline(mine[0]["start_mm"], color=INK, lw=1, ls=":")
        for row in mine:
            color, marker = OPTIMIZERS[row["method"]]
            draws = np.array(row["times_ms"][1:]) / row["draw_ms"]
            errors, alone = row["point_errors_mm"][1:], len(draws) == 1
            style = {"ms": 15 if alone else 5.5, "mec": "white", "mew": 0.8, "lw": 1.8, "zorder": 3 + alone}
            axes.plot(draws, errors, color=color, marker=marker, label=row["method"], **style)
        axes.set(xscale="log", yscale="log")
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:g}"[0] in "25" else "")
    drawing.supylabel("mean point error (mm)", color=FAINT, fontsize=10)
    drawing.supxlabel("time, in draws of the scene", color=FAINT, fontsize=10)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    style = {"frameon": False, "fontsize": 10, "labelcolor": INK, "columnspacing": 1.6}
    drawing.legend(handles, labels, loc="outside upper left", ncols=len(labels), **style)
    drawing.savefig(path, dpi=130)


def draw_basin(rows: list[dict[str, Any]], path: Path, pixels_per_mm: float) -> None:
    """Cosines of gradients and shares of arrivals over the displacement: a row of panels for each motion."""
    drawing = Figure(figsize=(15, 7.4), facecolor="white", layout="constrained")
    grid = drawing.subplots(2, 4, squeeze=False)
    units = {"translation": "displaced by (mm)", "rotation": "turned by (°)"}
    objects = list(dict.fromkeys(row["object"] for row in rows))
    for panels, (motion, unit) in zip(grid, units.items(), strict=True):
        for i, kind in enumerate(objects):
            mine = [row for row in rows if (row["motion"], row["object"]) == (motion, kind)]
            amounts = [row["amount"] for row in mine]
            slopes, ends = panels[i], panels[2 + i]
            _axes(slopes, f"{kind}: does down lead home?", unit, "" if i else "cosine")
            slopes.axhline(0, color=INK, lw=0.8)
            for key, (label, color, dash) in COSINES.items():
                if mine and mine[0].get(key) is not None:
                    slopes.plot(amounts, [row[key] for row in mine], color=color, ls=dash, lw=2, label=label)
            slopes.set(ylim=(-0.1, 1.04))
            _axes(ends, f"{kind}: who comes home", unit, "" if i else "share of starts")
            for width, (key, (label, color, marker)) in zip(WIDTHS, ARRIVALS.items(), strict=True):
                style = {"ms": 11 if marker == "*" else 6, "mec": "white", "mew": 0.8, "lw": width}
                shares = [row[key] for row in mine]
                ends.plot(amounts, shares, color=color, marker=marker, label=label, clip_on=False, **style)
            ends.set(ylim=(0, 1.04))
            if motion == "translation":
                for axes in (slopes, ends):
                    scale = (lambda mm: mm * pixels_per_mm, lambda px: px / pixels_per_mm)
                    top = axes.secondary_xaxis("top", functions=scale)
                    top.set_xticks(range(0, 21, 5))
                    top.tick_params(colors=FAINT, labelsize=8.5, length=0, pad=0)
                    top.set_xlabel("pixels", color=FAINT, fontsize=8.5, loc="right", labelpad=1)
                    top.spines["top"].set_visible(False)
    for panel, side in ((grid[0, 0], "left"), (grid[0, 2], "right")):
        handles, labels = panel.get_legend_handles_labels()
        style = {"frameon": False, "fontsize": 9.5, "labelcolor": INK, "columnspacing": 1.3}
        drawing.legend(handles, labels, loc=f"outside lower {side}", ncols=2, **style)
    drawing.savefig(path, dpi=120)


def draw_variants(axes: Axes, names: list[str], lengths: list[float], title: str) -> None:
    """A bar for each variant of an ablation; the line marks the variant with all parts on."""
    bars = axes.barh(names, lengths, color=["#444444" if name == "all on" else "#4c8cc4" for name in names])
    axes.bar_label(bars, [f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in lengths], padding=3)
    axes.set(title=title)
    axes.margins(x=0.3)
    if "all on" in names:
        axes.axvline(lengths[names.index("all on")], color="#444444", linewidth=1, linestyle=":")


def draw_ablation(rows: list[dict[str, Any]], panels: Sequence[tuple[str, str]], path: Path) -> None:
    """A panel for each score, by key and title, a bar for each variant: the mean over seeds, each of which is
    a dot."""
    names = list(dict.fromkeys(row["variant"] for row in rows))
    drawing = Figure(figsize=(14, 1.0 + 0.4 * len(names)), dpi=100, layout="constrained")
    places = drawing.subplots(1, len(panels), sharey=True)
    for axes, (key, title) in zip(places, panels, strict=True):
        each = [[row[key] or 0.0 for row in rows if row["variant"] == name] for name in names]
        draw_variants(axes, names, [float(np.mean(values)) for values in each], title)
        for place, values in enumerate(each):
            axes.plot(values, [place] * len(values), "k.", ms=4)
    places[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")


def _bars(
    axes: Axes, at: Sequence[float], found: list[list[float]], color: str, label: str | None, width: float
) -> None:
    """Bars of rates with their 95 % intervals, and the rates as text above them."""
    rates = [float(np.mean(values)) if values else np.nan for values in found]
    axes.bar(at, rates, width, color=color, label=label, zorder=2)
    for x, values, rate in zip(at, found, rates, strict=True):
        if values:
            low, high = wilson(sum(values), len(values))
            axes.plot([x, x], [low, high], color=INK, lw=1.2, zorder=3)
            axes.text(x, high + 0.02, f"{rate:.0%}", ha="center", va="bottom", fontsize=9.5, color=INK)


def _axes(axes: Axes, title: str, xlabel: str, ylabel: str) -> None:
    """The package's style of axes."""
    axes.set_title(title, loc="left", fontsize=11.5, fontweight="bold", color=INK, pad=10)
    axes.set_xlabel(xlabel, color=FAINT, fontsize=10)
    axes.set_ylabel(ylabel, color=FAINT, fontsize=10)
    axes.tick_params(colors=FAINT, labelsize=9.5, length=0, which="both")
    axes.grid(color=GRID, lw=0.8)
    axes.set_axisbelow(True)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.spines["bottom"].set_color(GRID)
