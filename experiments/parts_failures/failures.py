"""Where is a part no longer found? Four ways to be hard, from easy to hopeless."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import FIT, Options, run_parts

CASES = {
    **{f"wheel, {n} spokes": ("wheel", n) for n in (3, 6, 12)},
    **{f"slides by {n} mm": ("small", n / 1000) for n in (100, 30, 10, 3)},
    **{f"rod of {n} mm": ("thin", n / 1000) for n in (40, 20, 10, 5)},
    **{f"stands out by {n} mm": ("flush", n / 1000) for n in (20, 5, 1)},
}
NOTHING = {"iou": 0.0, "kind": "not found"}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery, from a canonical scene of its own."""
    case, amount = CASES[options["case"]]
    told = Options(
        f"simulated:hard_parts?case={case}&amount={amount}&width=240&height=180&seed={seed}",
        folder / "run",
        anchor=0,
        overwrite=True,
        fit=replace(FIT, steps=2000, cap=10_000),
    )
    run_parts(told)
    found = json.loads((told.out / "metrics.json").read_text())
    rows = {row["true_name"]: row for row in found["parts"] if row.get("true_name")}
    mine = rows.get("part", NOTHING)
    return {
        "iou": mine["iou"],
        "point_mm": mine.get("median_point_error_mm"),
        "moved_mm": mine.get("moved_mm"),
        "kind": mine["kind"],
        "axis_deg": mine.get("axis_deg"),
        "box_iou": rows.get("box", NOTHING)["iou"],
        "parts": found["num_parts"],
        "psnr": found["tracked"]["psnr"],
        "skipped": found["skipped"],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each way to be hard: overlap, with the point error and what the joint is called."""
    from matplotlib.figure import Figure

    ways = list(dict.fromkeys(CASES[row["case"]][0] for row in rows))
    drawing = Figure(figsize=(4 * len(ways), 3.6), dpi=110, layout="constrained")
    for axes, way in zip(drawing.subplots(1, len(ways), sharey=True, squeeze=False)[0], ways, strict=True):
        mine = [row for row in rows if CASES[row["case"]][0] == way]
        names = [row["case"].replace(" ", "\n", 1) for row in mine]
        bars = axes.bar(names, [row["iou"] for row in mine], color="#4c8cc4")
        told = [
            row["kind"] + ("" if row["point_mm"] is None else f"\n{row['point_mm']:.1f} mm") for row in mine
        ]
        axes.bar_label(bars, told, padding=2, fontsize=8)
        axes.set(ylim=(0, 1.2), yticks=(0, 0.5, 1))
        axes.tick_params(labelsize=8)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
    drawing.supylabel("overlap with the true part", fontsize=9)
    drawing.savefig(path)
