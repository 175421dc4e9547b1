"""The tracker where it may lose an object: does it, does it report so, and does it find it again?"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.hard_cases.faults import noisy_depth, without_cameras, without_frames
from experiments.hard_cases.stages import HEIGHT, STAGES, WIDTH, gripper, stage
from experiments.shared.recordings import Start, recorded, start_of, tracked
from gsjax.data import Sequence, Truth, open_sequence
from gsjax.data.simulated import tabletop
from gsjax.engine.recording import Recording, remembered
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.scoring import first_labels, lost_over_frames, score_motion, turn_unknown
from gsjax.methods.track import PRESETS, TrackConfig

START = TrackConfig(start=replace(PRESETS["fast"].start, iterations=40))  # few: colours hardly matter here
ASTRAY_MM = 20.0  # the objects are 60 to 130 mm long
TURNED_DEG = 8.0  # an object whose orientation is off by more than this ...
TURN_MM = 40.0  # ... may have its visible surface's centroid off by this, though its position is right
FEWEST_PIXELS = 30  # of all cameras together, for an object to count as visible
MOST_SILENT = 3  # consecutive frames in which an object may be astray before it is reported


def table(**how: bool) -> Sequence:
    """The scene that comes with the package."""
    return tabletop(frames=48, width=WIDTH, height=HEIGHT, **how)


def knocked(step: int) -> Sequence:
    """Every n-th frame of a MuJoCo recording in which boxes are knocked over."""
    return open_sequence(str(recorded("tabletop_1"))).select(slice(None, None, step))


CASES = {
    **{name: lambda name=name: stage(name) for name in STAGES},
    "hidden in a garage": lambda: table(hide=True),
    "leaves for good": lambda: table(leave=True),
    "gripper that closes": gripper,
    "moving cameras": lambda: table(moving_cameras=True),
    "depth of a Kinect": lambda: noisy_depth(table(), 1.0),
    "depth three times as bad": lambda: noisy_depth(table(), 3.0),
    "every fifth frame lost": lambda: without_frames(table(), {t for t in range(48) if t % 5 == 4}),
    "five frames lost at once": lambda: without_frames(table(), {*range(10, 15), *range(28, 33)}),
    "a camera drops out": lambda: without_cameras(table(), (1,), range(10, 25)),
    "two cameras drop out": lambda: without_cameras(table(), (1, 2), range(10, 25)),
    "tabletop_1": lambda: knocked(1),
    "tabletop_1, every other frame": lambda: knocked(2),
    "tabletop_1, every third frame": lambda: knocked(3),
}


@cache
def started(case: str) -> Start:
    """The recording and its scene at the first frame."""
    jax.clear_caches()  # every case has shapes of its own, and programs fill the process's memory map
    sequence = remembered(CASES[case]())
    return start_of(Recording(sequence, sequence, sequence.num_frames, True), START)


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Track the objects of one case, and judge each."""
    start = started(options["case"])
    recording, tracking = start.recording, tracked(start, PRESETS[options["preset"]])
    truth = recording.tracked.truth
    assert truth is not None
    names = dict(zip(truth.label_ids.tolist(), truth.names, strict=True))
    motion = score_motion(tracking, recording, first_labels(tracking, recording))
    pixels = seen_pixels(recording.tracked)
    objects = {
        names[label]: judge(
            score.centroid_errors_mm,
            turn_errors(tracking, truth, label),
            pixels[label],
            *reported(tracking, label),
        )
        for label, score in motion.items()
        if score.num_scored
    }
    worst = max(objects, key=lambda name: (objects[name]["silent"], *objects[name]["order"]))
    total = sum(o["sound_frames"] for o in objects.values())
    alarms = sum(o["false_alarms"] for o in objects.values())
    known = sum(o["turn_right_frames"] for o in objects.values())
    doubts = sum(o["false_doubts"] for o in objects.values())
    return {
        **{key: objects[worst][key] for key in ("verdict", "median_mm", "end_mm", "astray", "unsaid")},
        "worst": worst,
        "false_alarms": 100 * alarms / max(total, 1),
        "false_doubts": 100 * doubts / max(known, 1),
        "objects": {name: {k: v for k, v in o.items() if k != "order"} for name, o in objects.items()},
        "update_ms": 1e3 * np.median(tracking.update_s[3:]),
        "update_p95_ms": 1e3 * np.percentile(tracking.update_s[3:], 95),
    }


def seen_pixels(sequence: Sequence) -> dict[int, np.ndarray]:
    """Number of pixels of all cameras that truly show each label, frame by frame."""
    views = [(t, c) for t in range(sequence.num_frames) for c in range(sequence.num_cameras)]
    masks = np.stack([sequence.mask(t, c) for t, c in views])
    masks = masks.reshape(sequence.num_frames, -1)
    return {int(label): (masks == label).sum(axis=1) for label in sequence.truth.label_ids}


def reported(tracking: Tracking, label: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames in which the tracker reports an object as lost or unseen; and frames in which it reports the
    orientation as unknown."""
    mine = np.asarray(tracking.scene.label_ids)[1:] == label
    unseen = ~np.asarray(tracking.visible)[:, mine].any(axis=1)
    lost = lost_over_frames(tracking, None, label) | unseen
    return tuple(np.concatenate([[False], a]) for a in (lost, turn_unknown(tracking, None, label)))


def turn_errors(tracking: Tracking, truth: Truth, label: int) -> np.ndarray:
    """Angle between the tracked and the true rotation of an object since the first frame, degrees."""
    group = tracking.scene.label_ids.index(label)
    one = int(np.argmax(np.asarray(tracking.scene.labels) == group))  # any Gaussian turns with its object
    found = Rotation.from_quat(tracking.quats()[:, one], scalar_first=True)
    poses = truth.poses[: tracking.num_frames, truth.label_ids.tolist().index(label), :3, :3]
    true = Rotation.from_matrix(poses)
    apart = (found * found[0].inv()).inv() * (true * true[0].inv())
    return np.degrees(apart.magnitude())


def judge(
    errors: np.ndarray, turns: np.ndarray, pixels: np.ndarray, lost: np.ndarray, unsure: np.ndarray
) -> dict[str, Any]:
    """The outcome for one object, from values of each frame.

    Args:
        errors: errors of its centroid, millimetres.
        turns: errors of its orientation, degrees.
        pixels: number of pixels that truly show it.
        lost: whether the tracker reports it as lost or unseen.
        unsure: whether the tracker reports its orientation as unknown.
    """
    there = pixels >= FEWEST_PIXELS
    astray = (errors > ASTRAY_MM) & there
    wrongly = turns > TURNED_DEG
    noticed = lost | (unsure & wrongly & (errors <= TURN_MM))
    silent = longest(astray & ~noticed)
    ends = bool(astray[there][-1])
    if not astray.any():
        verdict = "sound"
    elif silent > MOST_SILENT or not (astray & noticed).any():
        verdict = "astray, unsaid"
    elif not (astray & lost).any():
        verdict = "turn unknown, said so"
    else:
        verdict = "lost, said so" if ends else "lost, found again"
    sound = there & ~astray
    return {
        "verdict": verdict,
        "order": (ends, int(astray.sum()), float(np.max(errors[there]))),
        "median_mm": float(np.median(errors[there])),
        "end_mm": float(errors[there][-1]),
        "astray": int(astray.sum()),
        "silent": silent,
        "unsaid": int((astray & ~noticed).sum()),
        "sound_frames": int(sound.sum()),
        "false_alarms": int((sound & lost).sum()),
        "turn_right_frames": int((there & ~wrongly).sum()),
        "false_doubts": int((there & ~wrongly & unsure & ~lost).sum()),
        "turns_deg": turns.round(1).tolist(),
        "errors_mm": errors.round(2).tolist(),
        "said": lost.tolist(),
        "unsure": unsure.tolist(),
        "there": there.tolist(),
    }


def longest(flags: np.ndarray) -> int:
    """The longest run of True."""
    runs = "".join("x" if flag else " " for flag in flags).split()
    return max(map(len, runs), default=0)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each case and preset."""
    from matplotlib.figure import Figure

    cases, presets = (list(dict.fromkeys(row[key] for row in rows)) for key in ("case", "preset"))
    columns = 2 * len(presets)
    height = -(-len(cases) // 2)
    drawing = Figure(figsize=(4.2 * columns, 2.1 * height), dpi=80, layout="constrained")
    grid = drawing.subplots(height, columns, squeeze=False, sharex=False, sharey=True)
    for axes in grid.ravel():
        axes.set_visible(False)
    for row in rows:
        place = cases.index(row["case"])
        axes = grid[place % height, place // height * len(presets) + presets.index(row["preset"])]
        axes.set_visible(True)
        for i, (name, found) in enumerate(row["objects"].items()):
            errors, lost = np.maximum(found["errors_mm"], 0.05), np.asarray(found["said"])
            there, frames = np.asarray(found["there"]), np.arange(len(errors))
            axes.plot(frames, np.where(there, errors, np.nan), color=f"C{i}", label=name, linewidth=1.5)
            axes.plot(frames, np.where(there, np.nan, errors), color=f"C{i}", linewidth=1, alpha=0.25)
            axes.plot(frames[lost], errors[lost], "o", color=f"C{i}", markersize=3.5)
        axes.axhline(ASTRAY_MM, color="#888888", linewidth=0.8, linestyle=":")
        axes.set(yscale="log", ylim=(0.05, 3000), yticks=(0.1, 1, 10, 100, 1000))
        axes.set_title(f"{row['case']}, {row['preset']}: {row['verdict']}", fontsize=9)
        axes.legend(fontsize=7, loc="upper left", ncols=2, frameon=False)
    drawing.supylabel("centroid error [mm]")
    drawing.supxlabel("frame")
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
