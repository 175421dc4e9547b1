"""What does the streaming step buy for its time: steps, size of pictures, Gaussians, cameras?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import FIT, Options, canonical_of, discovered, with_parts
from experiments.shared.recordings import recorded

HELD_OUT = (3, 8)
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "10 steps": {"stream": {"iterations": 10}},
    "20 steps": {"stream": {"iterations": 20}},
    "40 steps": {"stream": {"iterations": 40}},
    "120 steps": {"stream": {"iterations": 120}},
    "half the size alone": {"stream": {"coarse": 1.0}},
    "whole size alone": {"stream": {"coarse": 0.0}},
    "half, 20 steps": {"stream": {"coarse": 1.0, "iterations": 20}},
    "half, 20 steps, no past": {"stream": {"coarse": 1.0, "iterations": 20, "past": 0}},
}
CAPS = {"at most 4000 Gaussians": 4_000, "at most 8000": 8_000, "at most 30000": 30_000}
CAMERAS = {"four cameras": (0, 2, 5, 7)}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery on articulated_0."""
    name = options["setting"]
    cap = CAPS.get(name, FIT.cap)
    start = replace(FIT.start, count=min(FIT.start.count, cap))
    told = Options(
        str(recorded("articulated_0")),
        folder / "run",
        cameras=CAMERAS.get(name, ()),
        eval_cameras=HELD_OUT,
        anchor=0,
        overwrite=True,
        fit=replace(FIT, cap=cap, start=start),
    )
    told = with_parts(told, **SETTINGS.get(name, {}))
    return discovered(replace(told, scene=canonical_of(told, folder)))


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors and index over the time that a frame takes; the line is what no other setting beats in both."""
    from matplotlib.figure import Figure

    panels = (("point_mm", "median point error [mm]", 1), ("ari", "adjusted Rand index", -1))
    panels += (("held_out_psnr", "held-out PSNR [dB]", -1),)
    drawing = Figure(figsize=(16, 5), dpi=100, layout="constrained")
    for axes, (key, title, sign) in zip(drawing.subplots(1, len(panels)), panels, strict=True):
        known = sorted((row for row in rows if row[key] is not None), key=lambda row: row["update_s"])
        best, front = float("inf"), []
        for row in known:
            axes.plot(
                row["update_s"], row[key], "o", color="#444444" if row["setting"] == "default" else "C0"
            )
            place = {"xytext": (4, 4), "textcoords": "offset points", "fontsize": 7}
            axes.annotate(row["setting"], (row["update_s"], row[key]), **place)
            if sign * row[key] < best:
                best = sign * row[key]
                front.append((row["update_s"], row[key]))
        axes.plot(*zip(*front, strict=True), color="0.7", zorder=0, drawstyle="steps-post")
        axes.set(xlabel="seconds a frame", ylabel=title, xscale="log")
        axes.set_xticks([0.5, 1, 2, 4, 8], ["0.5", "1", "2", "4", "8"])
        axes.set_xticks([], minor=True)
        axes.grid(color="0.9")
    drawing.savefig(path)
