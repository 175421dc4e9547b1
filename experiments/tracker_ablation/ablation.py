"""The object-aware tracker with one of its parts switched off at a time.

`tabletop` is the package's built-in scene, frame by frame; `tabletop_0` is a MuJoCo recording of which every
third frame is taken, so that objects move far between frames.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.recordings import recorded, scored, started, tracked
from gsjax.methods.track import PRESETS, TrackConfig

RECORDINGS = {  # with the selected frames
    "tabletop": (lambda: "simulated:tabletop?width=240&height=180", "0:24"),
    "tabletop_0": (lambda: str(recorded("tabletop_0")), "0:60:3"),
}
CAMERAS, HELD_OUT = (0, 1), (2,)
FULL = PRESETS["paper"]


def without_alignment(config: TrackConfig) -> TrackConfig:
    """Without what the paper lacks: no Gauss-Newton, and no search over shifts and turns before it."""
    return replace(config, align=replace(config.align, iterations=0, reach=0.0, turns=()))


VARIANTS = {
    "all on": FULL,
    "no template matching": replace(FULL, matching=False),
    "translation only": replace(
        FULL, align=replace(FULL.align, max_turn=0.0), refine=replace(FULL.refine, rotation_rate=0.0)
    ),
    "background refined": replace(
        FULL, refine=replace(FULL.refine, background_rate=FULL.refine.translation_rate)
    ),
    "no warm start": replace(FULL, warm_start=False),
    "no alignment": without_alignment(FULL),
    "no alignment, no matching": without_alignment(replace(FULL, matching=False)),
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track with one variant, with the scores of `gsjax track`."""
    dataset, frames = RECORDINGS[options["recording"]]
    start = started(dataset(), frames, CAMERAS, HELD_OUT, FULL.start)
    tracking = tracked(start, VARIANTS[options["variant"]])
    return scored(start, tracking) | {"update_ms": 1e3 * np.median(tracking.update_s[1:])}


PANELS = (
    ("centroid_mm", "centroid error [mm]"),
    ("median_point_mm", "median point error [mm]"),
    ("mean_point_mm", "mean point error [mm]"),
    ("iou", "label IoU"),
    ("held_out_psnr", "held-out PSNR [dB]"),
    ("update_ms", "update [ms]"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A row of panels for each recording, a bar for each variant."""
    from matplotlib.figure import Figure

    from experiments.shared.plots import draw_variants

    recordings = list(dict.fromkeys(row["recording"] for row in rows))
    drawing = Figure(figsize=(16, 0.8 + 3.2 * len(recordings)), dpi=100, layout="constrained")
    grid = drawing.subplots(len(recordings), len(PANELS), squeeze=False, sharey="row")
    for panels, recording in zip(grid, recordings, strict=True):
        mine = [row for row in rows if row["recording"] == recording]
        names = [row["variant"] for row in mine]
        panels[0].set_ylabel(recording)
        for axes, (key, title) in zip(panels, PANELS, strict=True):
            draw_variants(axes, names, [row[key] for row in mine], title)
        panels[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
