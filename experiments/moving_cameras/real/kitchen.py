"""A hand-held Kinect in a kitchen in which nothing moves: how far do tracked objects stray?

In truth everything is static, which a tracker that does nothing gets right. So errors are compared with the
accuracy of the recording: the noise of a depth pixel, and the misalignment of its surfaces from frame to
frame, which is the noise of the camera's poses. The first mask is that of `PlaneOrRegionSegmenter`, which has
no weights and knows no object classes. Pictures are halved to 320x240.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from experiments.shared.recordings import recorded
from gsjax.data import Sequence, read_seven_scenes
from gsjax.engine.track.tracking import track
from gsjax.methods.track import PRESETS, first_pose, start_scene
from gsjax.perception.segmenters import PlaneOrRegionSegmenter

FRAMES = 40  # the recording has every third frame of a video: 4 s
NEAR_MM = 10.0
MOST = 0.5  # share of what the first frame showed of an object
SAME_SURFACE_M = 0.03  # a larger difference of depth is another surface
ENOUGH = 20  # pixels
BLUE, ORANGE, INK, FAINT, BAND = "#0072b2", "#d55e00", "#22262b", "#6b7280", "#d5d9de"


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track what the segmenter finds in the first frame, and measure how far each object strays."""
    recording = recorded("seven_scenes_kitchen")
    sequence = halved(read_seven_scenes(recording, register=options["registered"])).select(range(FRAMES))
    config, depth = PRESETS[options["preset"]], sequence.depth(0, 0)
    mask = PlaneOrRegionSegmenter()(sequence.image(0, 0), depth, sequence.Ks[0, 0])
    first = sequence.frame(0)
    scene = start_scene(first, mask, 0, config)
    values, count = np.asarray(scene.label_ids), scene.num_moving
    groups = np.asarray(scene.labels)[:count]
    names = sorted(set(values.tolist()) - {0})
    begun = np.asarray(first_pose(scene).means)
    strayed = np.full((FRAMES, len(names)), np.nan)
    strayed[0], skipped = 0.0, 0
    for t, now in enumerate(track(scene, first, (sequence.frame(t) for t in range(1, FRAMES)), config), 1):
        means, seen = np.asarray(now.result.pose.means)[:count], np.asarray(now.info["visible"])
        skipped += int(now.info["skipped"])
        for i, name in enumerate(names):
            parts = np.flatnonzero(values == name)
            if seen[parts - 1].any():
                its = np.isin(groups, parts)
                strayed[t, i] = 1e3 * np.linalg.norm(means[its].mean(axis=0) - begun[its].mean(axis=0))
    noise, shifts, shown = disagreement(sequence, mask, names)
    kept = np.cumprod(shown >= MOST, axis=0).astype(bool)  # until most of it first leaves the view
    worst, while_kept = np.nanmax(strayed, axis=0), np.where(kept, strayed, np.nan)
    at_most = np.nanmax(while_kept, axis=0)
    paths = np.linalg.inv(sequence.viewmats[:, 0])[:, :3]
    turns = np.einsum("ij,tij->t", paths[0, :, :3], paths[:, :, :3])
    return {
        "objects": len(names),
        "usual_stray_mm": np.nanmedian(while_kept[1:]),
        "median_stray_mm": np.median(at_most),
        "p90_stray_mm": np.percentile(at_most, 90),
        "within_10mm": 100 * np.mean(at_most < NEAR_MM),
        "median_stray_seen_mm": np.median(worst),
        "worst_stray_seen_mm": worst.max(),
        "depth_noise_mm": np.nanmedian(noise[kept]),
        "surface_shift_mm": np.nanmedian(shifts[kept]),
        "strayed_mm": strayed,
        "kept": kept,
        "shown": shown,
        "shifts_mm": shifts,
        "mask_pixels": [int((mask == name).sum()) for name in names],
        "seen_frames": np.isfinite(strayed).sum(axis=0),
        "times": sequence.times - sequence.times[0],
        "camera_moved_mm": 1e3 * np.linalg.norm(paths[:, :, 3] - paths[0, :, 3], axis=1).max(),
        "camera_turned_deg": np.degrees(np.arccos(np.clip((turns - 1) / 2, -1, 1))).max(),
        "skipped": skipped,
    }


def halved(sequence: Sequence) -> Sequence:
    """The sequence at half its size. Depth is taken from one pixel in four, since means mix surfaces."""
    width, height = sequence.width // 2, sequence.height // 2

    def image(t: int, c: int) -> np.ndarray:
        return cv2.resize(sequence.image(t, c), (width, height), interpolation=cv2.INTER_AREA)

    def depth(t: int, c: int) -> np.ndarray | None:
        full = sequence.depth(t, c)
        return None if full is None else full[::2, ::2]

    Ks = sequence.Ks.copy()
    Ks[..., :2, :] /= 2
    return replace(sequence, width=width, height=height, Ks=Ks, load_image=image, load_depth=depth)


def disagreement(sequence: Sequence, mask: np.ndarray, names: list[int]) -> tuple[np.ndarray, ...]:
    """Noise and misalignment of static objects in the depth images, by the camera's poses.

    Returns:
        noise: spread of a pixel's depth about its object's shift, mm, [T, K].
        shifts: distance of the object's surface from that of the first frame along the view, mm, [T, K].
        shown: share of what the first frame showed of it that is in view and not occluded, [T, K].
    """
    depth = sequence.depth(0, 0)
    assert depth is not None
    rows, columns = np.nonzero(np.isin(mask, names) & (depth > 0))
    K, z, of = sequence.Ks[0, 0], depth[rows, columns].astype(float), mask[rows, columns]
    rays = np.linalg.inv(K) @ np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))])
    world = np.linalg.inv(sequence.viewmats[0, 0]) @ np.concatenate([rays * z, np.ones((1, len(z)))])
    noise = np.full((sequence.num_frames, len(names)), np.nan)
    shifts, shown = noise.copy(), np.ones_like(noise)
    for t in range(1, sequence.num_frames):
        local = (sequence.viewmats[t, 0] @ world)[:3]
        x, y = np.floor((sequence.Ks[t, 0] @ local)[:2] / np.maximum(local[2], 1e-3)).astype(int)
        inside = (local[2] > 0.1) & (x >= 0) & (x < sequence.width) & (y >= 0) & (y < sequence.height)
        there = sequence.depth(t, 0)
        assert there is not None
        found = there[np.where(inside, y, 0), np.where(inside, x, 0)]
        gap = found - local[2]
        same = inside & (found > 0) & (np.abs(gap) < SAME_SURFACE_M)
        for i, name in enumerate(names):
            its = 1e3 * gap[same & (of == name)]
            shown[t, i] = len(its) / np.sum(of == name)
            if len(its) >= ENOUGH:
                shifts[t, i] = np.abs(np.median(its))
                noise[t, i] = 1.4826 * np.median(np.abs(its - np.median(its)))
    return noise, shifts, shown


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each case: each object's distance from its start over time."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.ticker import FuncFormatter

    drawing = Figure(figsize=(4.4 * len(rows), 4.6), dpi=130, layout="constrained")
    panels = np.atleast_1d(drawing.subplots(1, len(rows), sharex=True, sharey=True))
    low, high = 0.3, 1000.0
    for axes, row in zip(panels, rows, strict=True):
        times, strayed = np.array(row["times"]), np.array(row["strayed_mm"], float)
        kept, shifts = np.array(row["kept"]), np.array(row["shifts_mm"], float)
        shifts, while_kept = np.where(kept, shifts, np.nan), np.where(kept, strayed, np.nan)
        axes.fill_between(times[1:], low, np.nanmedian(shifts[1:], axis=1), color=BAND, linewidth=0)
        for line, its in zip(np.maximum(strayed, low).T, kept.T, strict=True):
            lost = ~its | np.append(~its[1:], False)  # the lines meet
            axes.plot(times[1:], np.where(lost, line, np.nan)[1:], color=ORANGE, linewidth=0.9, alpha=0.5)
            axes.plot(times[1:], np.where(its, line, np.nan)[1:], color=BLUE, linewidth=0.9, alpha=0.5)
        axes.plot(times[1:], np.nanmedian(while_kept[1:], axis=1), color=INK, linewidth=2.2)
        beside = "colour registered" if row["registered"] else "colour as it comes"
        axes.set_title(f"{row['preset']}, {beside}", loc="left", fontsize=11, fontweight="bold", color=INK)
        axes.set(yscale="log", ylim=(low, high), xlabel="seconds", xlim=(0, times[-1]))
        axes.set_xticks(range(int(times[-1]) + 1))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.grid(color="#e4e7eb", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(colors=FAINT)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("centroid from its start [mm]")
    handles = [
        Line2D([], [], color=BLUE, label="an object, most of it in view"),
        Line2D([], [], color=ORANGE, label="after most of it has left the view"),
        Line2D([], [], color=INK, linewidth=2.2, label="median of those in view"),
        Patch(color=BAND, label="their surfaces beside themselves, by the recording's poses"),
    ]
    drawing.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, labelcolor=INK)
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
