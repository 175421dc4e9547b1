"""How much does the discovery of parts depend on cameras, the anchor frame, room for parts, and the seed?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.shared.discoveries import Options, canonical_of, discovered, with_parts
from experiments.shared.recordings import recorded

HELD_OUT = (3, 8)
CAMERAS = {  # around the scene as evenly as may be
    10: (),
    8: (0, 1, 2, 4, 5, 6, 7, 9),
    6: (0, 2, 4, 5, 7, 9),
    4: (0, 2, 5, 7),
    3: (0, 4, 7),
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One discovery on articulated_0, different from the default in one thing."""
    what, value = options["what"], options["value"]
    cameras = CAMERAS[value if what == "cameras" else 8]
    told = Options(
        str(recorded("articulated_0")),
        folder / "run",
        cameras=cameras,
        eval_cameras=HELD_OUT if cameras else (),
        anchor=value if what == "anchor" else 0,
        overwrite=True,
    )
    if what == "room":
        told = with_parts(told, discover={"most_parts": value})
    if what == "seed":
        told = with_parts(told, top={"seed": value})
    return discovered(replace(told, scene=canonical_of(told, folder)))


PANELS = (
    ("ari", "adjusted Rand index"),
    ("true_found", "of 6 true parts found"),
    ("point_mm", "median point error [mm]"),
    ("train_psnr", "PSNR looked through [dB]"),
    ("held_out_psnr", "held-out PSNR [dB]"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A row of panels for each thing that is varied."""
    from matplotlib.figure import Figure

    whats = list(dict.fromkeys(row["what"] for row in rows))
    drawing = Figure(figsize=(15, 2.4 * len(whats)), dpi=100, layout="constrained")
    grid = drawing.subplots(len(whats), len(PANELS), sharey="col", squeeze=False)
    for axes, (_, title) in zip(grid[0], PANELS, strict=True):
        axes.set_title(title)
    for line, what in zip(grid, whats, strict=True):
        mine = [row for row in rows if row["what"] == what]
        names = [str(row["value"]) for row in mine]
        for axes, (key, _) in zip(line, PANELS, strict=True):
            heights = [row[key] or 0.0 for row in mine]
            bars = axes.bar(names, heights, color="#4c8cc4")
            labels = ["–" if row[key] is None else f"{row[key]:.3g}" for row in mine]
            axes.bar_label(bars, labels, padding=2, fontsize=8)
            axes.margins(y=0.2)
            axes.set_xlabel(what)
    drawing.savefig(path)
