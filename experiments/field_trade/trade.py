"""What does speed cost? Channels, levels, table, resolution and steps, one varied at a time."""

from pathlib import Path
from typing import Any

from experiments.shared.fields import articulated, codebook_of, flawed_teacher, learned, of_field, scored
from gsjax.engine.distill.scene import scaled
from gsjax.methods.distill import DistillConfig
from gsjax.scene.feature_grid import FeatureGridConfig

AXES = {
    "channels": "channels",
    "levels": "levels of the grid",
    "log2_entries": "log2 of a level's entries",
    "hidden": "width of the network",
    "scale": "resolution",
    "iterations": "steps",
}
MIDDLE = {"channels": 256, "levels": 16, "log2_entries": 20, "hidden": 128, "scale": 0.5, "iterations": 100}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One setting on articulated_0 with flawed masks; settings not named are those of `MIDDLE`."""
    given = MIDDLE | options
    scene = articulated(folder)
    names, codes = codebook_of(scene.photographs)
    small = scaled(scene, given["scale"])
    teacher, _ = flawed_teacher(scene, codes, seed, scale=given["scale"])
    grid = FeatureGridConfig(
        levels=given["levels"], log2_entries=given["log2_entries"], hidden=given["hidden"]
    )
    config = DistillConfig(iterations=given["iterations"], channels=given["channels"], grid=grid, seed=seed)
    found = learned(small, small.taught, teacher, config)
    # Scored at full resolution, whatever the training resolution.
    asked = scored(scene, of_field(found, codes), names, (found.field, found.located, codes))
    return {
        **asked,
        "step_ms": 1e3 * found.seconds / max(1, given["iterations"] - 1),
        "minutes": found.seconds / 60,
        "memory_mb": found.memory_mb,
        "trained": found.trained,
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """IoU over minutes, a line for each setting that was changed, through the one in the middle."""
    from matplotlib.figure import Figure

    drawing = Figure(figsize=(9, 5), dpi=110, layout="constrained")
    axes = drawing.subplots()
    middle = [row for row in rows if row.get("iterations") == MIDDLE["iterations"]]
    for name, words in AXES.items():
        some = [row for row in rows if row.get(name) is not None and row not in middle]
        some = sorted((*some, *(row | {name: MIDDLE[name]} for row in middle)), key=lambda row: row[name])
        if not some:
            continue
        axes.plot([r["minutes"] for r in some], [r["miou_3d"] for r in some], "o-", ms=4, label=words)
        for row in some:
            if row.get("iterations") == MIDDLE["iterations"] and name != "iterations":
                continue  # one label for the middle
            axes.annotate(f"{row[name]:g}", (row["minutes"], row["miou_3d"]), fontsize=7, va="bottom")
    axes.set(xscale="log", xlabel="minutes of steps", ylabel="mIoU of held-out views, 3D query")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
