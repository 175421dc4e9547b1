"""One frame-to-frame update by different optimizers: error over time, from the same start and images.

The update starts from a scene fitted to frame t and ends at frame t + gap, whose true motion is known.
"""

from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.optimizers import methods
from experiments.shared.one_update import Update, scene_at, update_of
from experiments.shared.recordings import MASK_CAMERA, recorded
from experiments.shared.timing import median_ms
from gsjax.engine.recording import open_recording

RECORDINGS = {  # with the frames that updates begin at
    "built-in": ("simulated:tabletop", (12,)),
    "tabletop_1": ("tabletop_1", (18, 34)),
}
COUNTS = [0, 1, 2, 4, 8, 16, 32]
METHODS = {
    "Adam, translation": partial(methods.adam, counts=COUNTS, rotation_rate=0.0),
    "Adam, SE(3)": partial(methods.adam, counts=COUNTS),
    "Adam, SE(3), rigid": partial(methods.adam, counts=COUNTS, delta_rate=0.0),
    "Levenberg-Marquardt": partial(methods.levenberg_marquardt, counts=[0, 1, 2, 4, 6, 10]),
    "ICP": partial(methods.icp, counts=COUNTS),
    "direct alignment": partial(methods.direct, counts=[0, 4, 8, 16, 32]),
    "direct, searched": partial(methods.direct, counts=[0, 12], find=methods.searched),
}
NEAR = 1.5  # an error of at most this times the best of all counts as arrived


@cache
def updates(recording: str, gap: int) -> list[Update]:
    """The updates of one kind; each scene is fitted once."""
    dataset, frames = RECORDINGS[recording]
    return [update_of(opened(dataset), scene(dataset, t), t, gap) for t in frames]


@cache
def opened(dataset: str):
    path = dataset if dataset.startswith("simulated:") else str(recorded(dataset))
    return open_recording(path, (), (), ":").tracked


@cache
def scene(dataset: str, t: int):
    return scene_at(opened(dataset), t, MASK_CAMERA)


@cache
def traces(recording: str, gap: int) -> dict[str, dict[str, Any]]:
    """All methods on one kind of update, since each is compared with the best; means over the updates."""
    given = updates(recording, gap)
    draws, found = [median_ms(methods.draw, update.batch) for update in given], {}
    for name, method in METHODS.items():
        runs = [method(update) for update in given]
        errors = [[update.errors(m) for m in run.motions] for update, run in zip(given, runs, strict=True)]
        draws += [median_ms(methods.draw, update.batch) for update in given]
        centroid, point = np.mean(errors, axis=0).T
        found[name] = {
            "counts": runs[0].counts,
            "centroid_mm": centroid,
            "point_mm": point,
            "ms": np.mean([run.ms for run in runs], axis=0),
        }
    return {name: {**trace, "draw_ms": np.median(draws)} for name, trace in found.items()}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One method on one kind of update. All methods run together the first time."""
    found = traces(options["recording"], options["gap"])
    mine = found[options["method"]]
    best = min(trace["point_mm"].min() for trace in found.values())
    there = np.flatnonzero(mine["point_mm"] <= NEAR * best)
    ms = (mine["ms"][-1] - mine["ms"][1]) / (mine["counts"][-1] - mine["counts"][1] or 1)
    each = ms if len(mine["counts"]) > 2 else mine["ms"][-1] / mine["counts"][-1]
    return {
        "start_mm": mine["point_mm"][0],
        "final_centroid_mm": mine["centroid_mm"][-1],
        "final_point_mm": mine["point_mm"][-1],
        "arrived_ms": mine["ms"][there[0]] if len(there) else None,
        "iteration_ms": each,
        "iteration_draws": each / mine["draw_ms"],
        "total_ms": mine["ms"][-1],
        "total_draws": mine["ms"][-1] / mine["draw_ms"],
        "iterations": mine["counts"],
        "centroid_errors_mm": mine["centroid_mm"],
        "point_errors_mm": mine["point_mm"],
        "times_ms": mine["ms"],
        "draw_ms": mine["draw_ms"],
    }


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each kind of update, a curve for each method."""
    from experiments.shared.plots import draw_optimizers

    draw_optimizers(rows, path)
