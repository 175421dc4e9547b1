"""Pareto plots of the sweep: error of image and gradient over time, a line for each knob."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

SAME = 120.0  # dB: more is rounding, and stands as this
CLOSEST = 1e-7  # 1 - cosine: closer is rounding
NINES = {
    1e-7: "1",
    1e-6: "0.999999",
    1e-5: "0.99999",
    1e-4: "0.9999",
    1e-3: "0.999",
    1e-2: "0.99",
    1e-1: "0.9",
}
KNOBS = {
    "alpha_min": ("#1f77b4", "o"),
    "min_transmittance": ("#ff7f0e", "s"),
    "max_per_tile": ("#2ca02c", "^"),
    "tile_size": ("#7f7f7f", "D"),
    "resolution": ("#d62728", "v"),
    "colors": ("#9467bd", "P"),
    "antialiased": ("#8c564b", "X"),
    "roi": ("#e377c2", "<"),
    "reads": ("#17becf", ">"),
    "sh_degree": ("#bcbd22", "p"),
}
AROUND = ((9, 9), (-9, 9), (9, -14), (-9, -14), (22, -3), (-22, -3), (0, 14), (0, -19))
OFFSETS = [(far * x, far * y) for far in (1, 1.5, 2, 2.5, 3, 4) for x, y in AROUND]  # points


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """One row of panels a scene: PSNR over forward time, gradient cosine over forward+backward time."""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    drawing = Figure(figsize=(16, 1 + 7 * len(scenes)), dpi=100, layout="constrained")
    FigureCanvasAgg(drawing)  # knows how large text is
    grid = drawing.subplots(len(scenes), 2, squeeze=False)
    for panels, scene in zip(grid, scenes, strict=True):
        mine = [row for row in rows if row["scene"] == scene]
        panels[0].set(title=f"{scene}: image", xlabel="forward time / default", ylabel="PSNR [dB]")
        panels[1].set(title=f"{scene}: gradient", xlabel="forward+backward time / default", ylabel="cosine")
        panels[1].set_yscale("log")
        panels[1].invert_yaxis()
        panels[1].set_yticks(list(NINES), list(NINES.values()))
        panels[1].minorticks_off()
        draw_lines(panels[0], mine, "forward_ratio", lambda row: row["psnr"])
        draw_lines(panels[1], mine, "both_ratio", lambda row: max(CLOSEST, 1 - row["gradient_cosine"]))
    handles, names = grid[0, 0].get_legend_handles_labels()
    drawing.legend(handles, names, loc="outside upper center", ncols=len(names))
    drawing.draw_without_rendering()  # so that the panels are where they will be, and labels can be placed
    drawing.set_layout_engine("none")
    for axes in grid.flat:
        place_labels(axes)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")


def draw_lines(axes: Axes, rows: list[dict[str, Any]], time: str, height) -> None:
    """A line from the defaults through each knob's values; noise is how far their own points lie from 1."""
    axes.labelled = []
    for knob, (color, marker) in KNOBS.items():
        mine = [row for row in rows if row["knob"] == knob]
        if not mine:
            continue
        points = np.array([(1.0 if row["is_default"] else row[time], height(row)) for row in mine])
        axes.plot(*points.T, color=color, marker=marker, label=knob, linewidth=1.2, markersize=7, alpha=0.85)
        doubts = [0.0 if row["is_default"] else row[time.replace("ratio", "doubt")] for row in mine]
        axes.errorbar(*points.T, xerr=doubts, fmt="none", ecolor=color, elinewidth=3, alpha=0.35)
        values = [label_of(row) for row in mine]
        axes.labelled += [(p, v, color) for p, v in zip(points, values, strict=True) if v is not None]
    best = height({"psnr": SAME, "gradient_cosine": 1.0})
    axes.default = (1.0, best)
    axes.plot(*axes.default, "kx", markersize=13, markeredgewidth=2.5, label="defaults")
    axes.set_xscale("log")
    ticks = [tick for tick in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3) if in_sight(axes, tick)]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.margins(0.08)
    axes.grid(alpha=0.3)


def label_of(row: dict[str, Any]) -> str | None:
    """The value, or what is switched on; the defaults have their cross."""
    if row["is_default"]:
        return None
    return row["knob"] if row["value"] is True else str(row["value"])


def in_sight(axes: Axes, tick: float) -> bool:
    low, high = axes.get_xlim()
    return low <= tick <= high


def place_labels(axes: Axes) -> None:
    """Each value beside its point, in the first place that no other label or point takes."""
    spots = axes.transData.transform([point for point, *_ in axes.labelled])
    x, y = axes.transData.transform(axes.default)
    taken = [Bbox.from_extents(x - 9, y - 9, x + 9, y + 9)]  # the cross
    for point, text, color in axes.labelled:
        for offset in OFFSETS:
            label = axes.annotate(
                text, point, offset, textcoords="offset points", color=color, fontsize=10, ha="center"
            )
            box = label.get_window_extent()
            clear = not any(box.overlaps(other) for other in taken)
            clear &= not any(box.x0 - 4 < x < box.x1 + 4 and box.y0 - 4 < y < box.y1 + 4 for x, y in spots)
            if clear or offset == OFFSETS[-1]:
                taken.append(box)
                break
            label.remove()
