"""How well are held-out views of a static scene rendered, minute by minute?"""

import json
from pathlib import Path
from typing import Any

from experiments.shared.recordings import recorded
from gsjax.data import ReadOptions
from gsjax.engine.fit.run import Options
from gsjax.engine.fit.run import run as run_fit
from gsjax.engine.machine import resident_mb
from gsjax.methods.fit import FitConfig

GOAL_DB = 25.0
# fox at 270x480, the others at 320x240. The K of icl_living_room has pixel centres at integers.
SCENES: dict[str, dict[str, Any]] = {
    "fox": {"scale": 0.25},
    "icl_living_room": {"scale": 0.5, "read": ReadOptions(K=(525.0, 525.0, 320.0, 240.0))},
    "seven_scenes_kitchen": {"scale": 0.5},
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One fit by `gsjax fit`."""
    how = SCENES[options["scene"]]
    depth_weight = 0.0 if options["scene"] == "fox" else 0.5
    config = FitConfig(steps=30_000, seed=seed, depth_weight=depth_weight)
    out = folder / "run"
    run_fit(
        Options(
            str(recorded(options["scene"])),
            out,
            minutes=options["minutes"],
            judge_every=100,
            overwrite=True,
            fit=config,
            **how,
        )
    )
    found = json.loads((out / "metrics.json").read_text())
    curve = [row for row in found["curve"] if row["test_psnr"] is not None]
    reached = [row["seconds"] / 60 for row in curve if row["test_psnr"] >= GOAL_DB]
    return {
        **found["test"],
        "minutes_to_25": min(reached) if reached else None,
        "gaussians": found["num_gaussians"],
        "steps": found["steps"],
        "steps_a_second": found["steps"] / found["seconds"]["fit"],
        "memory_mb": resident_mb(),
        "curve": [(row["seconds"] / 60, row["test_psnr"]) for row in curve],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """PSNR over minutes, a line for each fit."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(7, 4), layout="constrained")
    axes = drawing.subplots()
    for row in rows:
        minutes, psnr = zip(*row["curve"], strict=True)
        axes.plot(minutes, psnr, label=f"{row['scene']}, {row['minutes']} minutes")
    axes.axhline(GOAL_DB, color="0.6", lw=1, ls=":")
    axes.set_xlabel("minutes")
    axes.set_ylabel("held-out PSNR [dB]")
    axes.grid(color="0.9")
    axes.legend(frameon=False)
    drawing.savefig(path, dpi=120)
