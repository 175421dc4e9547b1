"""Update rate against accuracy, one knob of the tracker at a time around the preset `fast`."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from experiments.shared.recordings import Start, recorded, scored, started, tracked
from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.track import PRESETS, TrackConfig

FAST = PRESETS["fast"]
CAMERAS = (0, 1, 2)
WARM = 3  # first updates that are not timed: they fault their memory in
ROUNDING = 3e-4  # by which colours differ between runs, as between machines


def setting(knob: str, value: Any) -> TrackConfig:
    """`fast` with one knob turned."""

    def align(**changes) -> TrackConfig:
        return replace(FAST, align=replace(FAST.align, **changes))

    def start(**changes) -> TrackConfig:
        return replace(FAST, start=replace(FAST.start, **changes))

    whole = replace(FAST, redraw="all", coarseness=1)
    match knob:
        case "preset":
            return PRESETS[value]
        case "iterations":
            return align(iterations=value)
        case "image size":
            return replace(FAST, shrink=int(value.removeprefix("1/")))
        case "Gaussians":  # the width of the voxels that keep one point each, in pixels
            return start(object_pixels=value, background_pixels=2.4 * value)
        case "cameras":  # the mask's first
            return replace(FAST, cameras=(1, 0, 2)[:value])
        case "redraw":
            return whole if value == "all" else replace(FAST, coarseness=1)
        case "everywhere":
            return align(everywhere=None if value == "all" else value)
        case "points":
            return align(pixels=value, centers=max(1, 2 * value // 3))
        case "refine":
            return replace(whole, refine=replace(FAST.refine, iterations=value))
    raise ValueError(f"knob: {knob} is none of this experiment")


@lru_cache(maxsize=1)
def starts(dataset: str, config: TrackConfig) -> tuple[Start, Start]:
    """The starts of a setting and of `fast`. Programs of the setting before are dropped, since each setting
    compiles its own, which would fill the process's memory map."""
    jax.clear_caches()
    return started(dataset, ":", CAMERAS, (), config.start), started(dataset, ":", CAMERAS, (), FAST.start)


def rounded(start: Start, seed: int) -> Start:
    """A start with colours changed by rounding, since single runs of a chaotic system mean little. Seed 0
    changes nothing."""
    colors = start.scene.gaussians.sh0
    noise = ROUNDING / SH_C0 * (seed > 0) * jax.random.normal(jax.random.key(seed), colors.shape)
    return start._replace(scene=eqx.tree_at(lambda s: s.gaussians.sh0, start.scene, colors + noise))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track a recording with one setting, and with `fast` right after it."""
    config, dataset = setting(options["knob"], options["value"]), str(recorded(options["recording"]))
    start, usual = (rounded(start, seed) for start in starts(dataset, config))
    tracking, beside = tracked(start, config), tracked(usual, FAST)
    milliseconds = 1e3 * np.asarray(tracking.update_s[1 + WARM :])
    reference = 1e3 * np.asarray(beside.update_s[1 + WARM :])
    return scored(start, tracking, every=6) | {
        "update_ms": float(np.median(milliseconds)),
        "update_p95_ms": float(np.percentile(milliseconds, 95)),
        "ratio": float(np.median(milliseconds) / np.median(reference)),
        "gaussians": start.scene.gaussians.num,
    }


PANELS = (
    ("centroid_mm", "centroid error [mm]", True),
    ("median_point_mm", "median point error [mm]", True),
    ("iou", "label IoU", False),
    ("tracked_psnr", "PSNR, tracked cameras [dB]", False),
)
KNOBS = ("iterations", "image size", "Gaussians", "cameras", "redraw", "everywhere", "points", "refine")


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A row of panels for each recording, a line for each knob; means over the seeds."""
    from matplotlib.figure import Figure

    rows = means(in_one_time(rows))
    recordings = list(dict.fromkeys(row["recording"] for row in rows))
    drawing = Figure(figsize=(18, 1 + 4.6 * len(recordings)), dpi=90, layout="constrained")
    grid = drawing.subplots(len(recordings), len(PANELS), squeeze=False)
    for panels, recording in zip(grid, recordings, strict=True):
        mine = [row for row in rows if row["recording"] == recording]
        presets = {row["value"]: row for row in mine if row["knob"] == "preset"}
        for axes, (key, title, lower) in zip(panels, PANELS, strict=True):
            draw_front(axes, mine, key, lower)
            for i, knob in enumerate(KNOBS):
                turned = [row for row in mine if row["knob"] == knob]
                line = sorted([*turned, *([presets["fast"]] if "fast" in presets else [])], key=rate)
                axes.plot([rate(r) for r in line], [r[key] for r in line], color=f"C{i}", linewidth=1.2)
                axes.plot([rate(r) for r in turned], [r[key] for r in turned], "o", color=f"C{i}", label=knob)
                for row in turned:
                    place = {"textcoords": "offset points", "xytext": (4, 4), "fontsize": 8}
                    axes.annotate(str(row["value"]), (rate(row), row[key]), color=f"C{i}", **place)
            for name, row in presets.items():
                axes.plot(rate(row), row[key], "*", color="black", markersize=13)
                place = {"textcoords": "offset points", "xytext": (6, -12), "fontsize": 9, "weight": "bold"}
                axes.annotate(name, (rate(row), row[key]), **place)
            axes.axvline(30, color="#888888", linewidth=0.8, linestyle=":")
            axes.set(xscale="log", title=f"{recording}: {title}", xlabel="updates a second")
            if lower:
                axes.set_yscale("log")
    handles, names = grid[0, 0].get_legend_handles_labels()
    drawing.legend(handles, names, loc="outside lower center", ncols=len(KNOBS), frameon=False)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")


def in_one_time(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with their times normalised to the median time of `fast`, which ran right after each setting."""
    usual = {}
    for recording in {row["recording"] for row in rows}:
        beside = [row["update_ms"] / row["ratio"] for row in rows if row["recording"] == recording]
        usual[recording] = float(np.median(beside))
    return [row | {"update_ms": row["ratio"] * usual[row["recording"]]} for row in rows]


def means(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each setting and recording."""
    grouped: dict[tuple, list[dict[str, Any]]] = {}
    for row in rows:
        grouped.setdefault((row["knob"], row["value"], row["recording"]), []).append(row)
    keys = ("update_ms", *(key for key, *_ in PANELS))
    return [same[0] | {key: np.mean([row[key] for row in same]) for key in keys} for same in grouped.values()]


def rate(row: dict[str, Any]) -> float:
    """Updates a second."""
    return 1e3 / row["update_ms"]


def draw_front(axes, rows: list[dict[str, Any]], key: str, lower: bool) -> None:
    """The best value that any setting reaches at a rate or a higher one."""
    best, ordered = [], sorted(rows, key=rate, reverse=True)
    for row in ordered:
        worst = np.inf if lower else -np.inf
        known = best[-1] if best else worst
        best.append(min(known, row[key]) if lower else max(known, row[key]))
    axes.step([rate(row) for row in ordered], best, where="post", color="#bbbbbb", linewidth=5, zorder=0)
