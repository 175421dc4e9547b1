"""Does the discovery of parts survive every anchor? All frames of a recording, each as the canonical one."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import FIT, Options, discovered, with_parts
from experiments.shared.recordings import recorded


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery on articulated_0, in small and with few steps: whether it holds, not how good it gets."""
    told = Options(
        str(recorded("articulated_0")),
        folder / "run",
        eval_cameras=(3, 8),
        scale=0.5,
        anchor=options["anchor"],
        overwrite=True,
        fit=replace(FIT, steps=600, cap=6_000, start=replace(FIT.start, count=5_000)),
    )
    return discovered(
        with_parts(told, stream={"iterations": 20, "past": 0}, refine={"iterations": 100}, top={"seed": seed})
    )


PANELS = (
    ("ari", "adjusted Rand index"),
    ("true_found", "of 6 true parts found"),
    ("point_mm", "median point error [mm]"),
    ("held_out_psnr", "held-out PSNR [dB]"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, over the anchors."""
    from matplotlib.figure import Figure

    rows = sorted(rows, key=lambda row: row["anchor"])
    drawing = Figure(figsize=(8, 7), dpi=110, layout="constrained")
    for axes, (key, title) in zip(drawing.subplots(len(PANELS), 1, sharex=True), PANELS, strict=True):
        known = [row for row in rows if row[key] is not None]
        axes.plot([row["anchor"] for row in known], [row[key] for row in known], "o-", color="#0072b2", ms=4)
        axes.set_ylabel(title, fontsize=8)
        axes.set_ylim(bottom=0)
        axes.grid(color="0.9")
    axes.set_xlabel("anchor frame")
    drawing.savefig(path)
