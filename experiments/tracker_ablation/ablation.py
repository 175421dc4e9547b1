"""The object-aware tracker with one of its parts switched off at a time.

`tabletop` is the scene that comes with the package, frame by frame; `tabletop_0` is a recording of MuJoCo's,
of which every third frame is taken, so that objects move far from one to the next.
"""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from gsjax.cli.loop import follow
from gsjax.cli.recording import FirstMask, Recording, draw_ahead, first_mask, open_recording
from gsjax.cli.scoring import Scores, group_values, metrics, score_motion
from gsjax.cli.views import views
from gsjax.methods.object_tracker import TrackedScene, TrackerConfig, start_scene
from gsjax.scene.frame import Frame

DATA = Path(os.environ.get("GSJAX_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
RECORDINGS = {  # with the frames that are taken
    "tabletop": ("simulated:tabletop?width=240&height=180", "0:24"),
    "tabletop_0": (str(DATA / "tabletop_0"), "0:60:3"),
}
CAMERAS, MASK_CAMERA, HELD_OUT = (0, 1), 1, (2,)
MOVED_MM = 30.0  # an object that moves less says little about a tracker
FULL = TrackerConfig()


def without_alignment(config: TrackerConfig) -> TrackerConfig:
    """What the paper has not: no Gauss-Newton, and no search by shifts and turns before it."""
    return replace(config, align=replace(config.align, iterations=0, reach=0.0, turns=(0.0,)))


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


class Start(NamedTuple):
    """What all variants begin with."""

    recording: Recording
    mask: FirstMask
    frame: Frame
    scene: TrackedScene


@cache
def started(name: str) -> Start:
    """The recording and its scene at the first frame, which no switch changes: made once."""
    dataset, frames = RECORDINGS[name]
    if not dataset.startswith("simulated:") and not Path(dataset).exists():
        raise FileNotFoundError(f"{dataset}: not there; set GSJAX_DATA to the folder that holds {name}")
    recording = open_recording(dataset, CAMERAS, HELD_OUT, frames)
    draw_ahead(recording, Console(stderr=True, quiet=True))
    mask, frame = first_mask(recording.tracked, MASK_CAMERA, "files"), recording.tracked.frame(0)
    assert mask.labels is not None
    return Start(recording, mask, frame, start_scene(frame, mask.labels, CAMERAS.index(MASK_CAMERA), FULL))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track with one variant, and score as `gsjax track` does."""
    recording, mask, frame, scene = started(options["recording"])
    quiet = Console(stderr=True, quiet=True)
    tracking = follow(scene, frame, recording.tracked, VARIANTS[options["variant"]], quiet)
    if tracking.stopped is not None:
        raise tracking.stopped
    values, truth = group_values(tracking, mask, recording), recording.tracked.truth
    scores = Scores(values, None if truth is None else truth.robot)
    for views_of_frame in views(tracking, recording):
        for view in views_of_frame:
            scores.add(view)
    found = metrics(tracking, recording, mask, scores, score_motion(tracking, recording), values)
    moved = {name: s for name, s in found["objects"].items() if (s["moved_mm"] or 0) > MOVED_MM}
    centroids = {name: s["centroid_error_mm"] for name, s in moved.items()}
    return {
        "centroid_mm": np.mean(list(centroids.values())),
        "worst_centroid_mm": max(centroids.values()),
        "median_point_mm": np.mean([s["median_point_error_mm"] for s in moved.values()]),
        "mean_point_mm": np.mean([s["point_error_mm"] for s in moved.values()]),
        "iou": np.mean([found["iou"][name] for name in moved]),
        "held_out_psnr": found["held_out"]["psnr_covered"],
        "tracked_psnr": found["tracked"]["psnr"],
        "update_ms": 1e3 * np.median(tracking.update_s[1:]),
        "skipped": tracking.skipped,
        "objects": [f"{name}: {mm:.1f} mm" for name, mm in centroids.items()],
    }


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

    recordings = list(dict.fromkeys(row["recording"] for row in rows))
    drawing = Figure(figsize=(16, 0.8 + 3.2 * len(recordings)), dpi=100, layout="constrained")
    grid = drawing.subplots(len(recordings), len(PANELS), squeeze=False, sharey="row")
    for panels, recording in zip(grid, recordings, strict=True):
        mine = [row for row in rows if row["recording"] == recording]
        names = [row["variant"] for row in mine]
        panels[0].set_ylabel(recording)
        for axes, (key, title) in zip(panels, PANELS, strict=True):
            lengths = [row[key] for row in mine]
            bars = axes.barh(names, lengths, color=["#444444" if n == "all on" else "#4c8cc4" for n in names])
            axes.bar_label(bars, [f"{v:.3g}" if v < 100 else f"{v:.0f}" for v in lengths], padding=3)
            axes.set(title=title)
            axes.margins(x=0.3)
            if "all on" in names:
                axes.axvline(lengths[names.index("all on")], color="#444444", linewidth=1, linestyle=":")
        panels[0].invert_yaxis()
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
