"""The built-in scene, once from fixed cameras and once from cameras that sway by 6 degrees around the table.

Both are tracked side by side, with alternating updates, so that other load on the machine affects both times
alike. Labels come from the true mask of the first frame; camera poses are exact.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.recordings import labels_at
from gsjax.data import Sequence
from gsjax.data.simulated import tabletop
from gsjax.engine.drive import Tick
from gsjax.engine.track.results import MOVED_MM
from gsjax.engine.track.tracking import track
from gsjax.methods.track import PRESETS, TrackConfig, TrackedScene, first_pose, start_scene
from gsjax.metrics.tracking import ObjectScore, score_tracks

FRAMES, WIDTH, HEIGHT, CAMERAS, MASK_CAMERA = 24, 240, 180, 2, 1
WARM_UP = 2  # first updates whose times are left out
KINDS = {"fixed": False, "moving": True}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track both scenes, and score each object's Gaussians against its true motion."""
    config = PRESETS[options["preset"]]
    recordings = [
        tabletop(seed, FRAMES, WIDTH, HEIGHT, CAMERAS, moving_cameras=moving) for moving in KINDS.values()
    ]
    scenes = [started(recording, config) for recording in recordings]
    updates = map(followed, scenes, recordings, [config] * len(scenes))
    tracked = list(zip(*updates, strict=True))
    seconds = np.array([[update.seconds for update in pair] for pair in tracked])[WARM_UP:]
    found: dict[str, Any] = {"update_ratio": np.median(seconds[:, 1] / seconds[:, 0])}
    for i, kind in enumerate(KINDS):
        recording, scene, ran = recordings[i], scenes[i], tuple(pair[i] for pair in tracked)
        scores = score(recording, scene, ran)
        moved = {name: s.centroid_error_mm for name, s in scores.items() if s.moved_mm > MOVED_MM}
        found |= {
            f"{kind}_centroid_mm": np.mean(list(moved.values())),
            f"{kind}_worst_mm": max(moved.values()),
            f"{kind}_still_mm": scores["block"].centroid_error_mm,
            f"{kind}_objects_mm": [s.centroid_error_mm for s in scores.values()],
            "objects": list(scores),
        }
    turned = np.degrees(np.arccos(np.clip(directions(recordings[1]) @ directions(recordings[1])[0], -1, 1)))
    return found | {"camera_turned_deg": turned.max()}


def started(recording: Sequence, config: TrackConfig) -> TrackedScene:
    """The scene at the first frame, with the true mask of one camera."""
    mask = recording.mask(0, MASK_CAMERA)
    assert mask is not None
    return start_scene(recording.frame(0), mask, MASK_CAMERA, config)


def followed(scene: TrackedScene, recording: Sequence, config: TrackConfig) -> Iterator[Tick]:
    """One update a frame, made on demand."""
    return track(scene, recording.frame(0), (recording.frame(t) for t in range(1, FRAMES)), config)


def score(recording: Sequence, scene: TrackedScene, ran: tuple[Tick, ...]) -> dict[str, ObjectScore]:
    """Errors by object, over all Gaussians whose true object is known, whatever their tracked label."""
    truth, count = recording.truth, scene.num_moving
    assert truth is not None
    background = np.asarray(scene.gaussians.means)[count:]
    poses = [first_pose(scene), *(now.result.pose for now in ran)]
    means = np.stack([np.concatenate([np.asarray(pose.means)[:count], background]) for pose in poses])
    labels = labels_at(recording, means[0])
    scores = score_tracks(means, labels, {int(k): truth.poses[:, i] for i, k in enumerate(truth.label_ids)})
    return dict(zip(truth.names, scores.values(), strict=True))


def directions(recording: Sequence) -> np.ndarray:
    """Where the first camera looks in each frame."""
    return recording.viewmats[:, 0, 2, :3]


COLORS = {"accurate": "#0072b2", "fast": "#d55e00"}
MARKS = {"carton": "s", "can": "p", "ball": "^", "block": "D"}  # the block is static


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A point for each object and seed: error with moving cameras over error with fixed ones."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FuncFormatter

    drawing = Figure(figsize=(5.4, 5.2), dpi=150, layout="constrained")
    axes = drawing.subplots()
    low, high = 0.01, 100.0  # smaller errors are drawn at the edge
    axes.plot([low, high], [low, high], color="#9aa1aa", linewidth=1, zorder=1)
    axes.text(50, 72, "alike", color="#6b7280", fontsize=9, rotation=45, ha="center", va="center")
    for row in rows:
        for name, fixed, moving in zip(
            row["objects"], row["fixed_objects_mm"], row["moving_objects_mm"], strict=True
        ):
            axes.scatter(
                np.clip(fixed, low, high),
                np.clip(moving, low, high),
                s=46,
                marker=MARKS[name],
                color=COLORS[row["preset"]],
                alpha=0.85,
                edgecolor="white",
                linewidth=0.8,
                zorder=3,
                clip_on=False,
            )
    axes.set(
        xscale="log",
        yscale="log",
        xlim=(low, high),
        ylim=(low, high),
        aspect="equal",
        xlabel="centroid error, fixed cameras [mm]",
        ylabel="centroid error, moving cameras [mm]",
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(color="#e4e7eb", linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    keys = [(preset, "o", color) for preset, color in COLORS.items()]
    keys += [(name, mark, "#6b7280") for name, mark in MARKS.items()]
    handles = [Line2D([], [], color=c, marker=m, linestyle="", label=name) for name, m, c in keys]
    axes.legend(handles=handles, loc="upper left", frameon=False, fontsize=9)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
