"""The tracker where it may lose an object: does it, does it say so, and does it find it again?"""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from experiments.hard_cases.faults import noisy_depth, without_cameras, without_frames
from experiments.hard_cases.stages import HEIGHT, STAGES, WIDTH, gripper, stage
from experiments.shared.recordings import MASK_CAMERA, QUIET, Start, recorded, tracked
from gsjax.data import Sequence, Truth, open_sequence
from gsjax.data.simulated import tabletop
from gsjax.engine.recording import Recording, draw_ahead, first_mask, remembered
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.scoring import lost_over_frames, score_motion, turn_unknown
from gsjax.methods.track import PRESETS, TrackConfig, start_scene

START = TrackConfig(start=replace(PRESETS["fast"].start, iterations=40))  # colours hardly matter here
ASTRAY_MM = 20.0  # the objects are 60 to 130 mm long
TURNED_DEG = 8.0  # an object that is turned otherwise by more than this ...
TURN_MM = 40.0  # ... may have its seen surface's centroid so far off, though its place is right
FEWEST_PIXELS = 30  # of all cameras together, that show what can be followed
MOST_SILENT = 3  # frames in a row in which an object may be astray before that is said


def table(**how: bool) -> Sequence:
    """The scene that comes with the package."""
    return tabletop(frames=48, width=WIDTH, height=HEIGHT, **how)


def knocked(step: int) -> Sequence:
    """Every so-manieth frame of a MuJoCo recording in which boxes are knocked over."""
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
    recording = Recording(sequence, sequence, sequence.num_frames, True)
    mask, frame = first_mask(sequence, MASK_CAMERA, "files"), sequence.frame(0)
    assert mask.labels is not None
    draw_ahead(recording, QUIET)
    return Start(recording, mask, frame, start_scene(frame, mask.labels, MASK_CAMERA, START))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Follow the objects of one case, and say of each what became of it."""
    start = started(options["case"])
    recording, tracking = start.recording, tracked(start, PRESETS[options["preset"]])
    truth = recording.tracked.truth
    assert truth is not None
    names = dict(zip(truth.label_ids.tolist(), truth.names, strict=True))
    motion, pixels = score_motion(tracking, recording), seen_pixels(recording.tracked)
    objects = {
        names[label]: judge(
            score.centroid_errors_mm,
            turn_errors(tracking, truth, label),
            pixels[label],
            *said(tracking, label),
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
    }


def seen_pixels(sequence: Sequence) -> dict[int, np.ndarray]:
    """How many pixels of all cameras truly show each label, frame by frame."""
    views = [(t, c) for t in range(sequence.num_frames) for c in range(sequence.num_cameras)]
    masks = np.stack([sequence.mask(t, c) for t, c in views])
    masks = masks.reshape(sequence.num_frames, -1)
    return {int(label): (masks == label).sum(axis=1) for label in sequence.truth.label_ids}


def said(tracking: Tracking, label: int) -> tuple[np.ndarray, np.ndarray]:
    """In which frames the tracker says that the object is lost, or that it sees none of it; and in which that
    it does not know how the object is turned."""
    mine = np.asarray(tracking.scene.label_ids)[1:] == label
    unseen = ~np.asarray(tracking.visible)[:, mine].any(axis=1)
    lost = lost_over_frames(tracking, None, label) | unseen
    return tuple(np.concatenate([[False], a]) for a in (lost, turn_unknown(tracking, None, label)))


def turn_errors(tracking: Tracking, truth: Truth, label: int) -> np.ndarray:
    """Angle between how the tracker and the truth have turned an object since the first frame, degrees."""
    group = tracking.scene.label_ids.index(label)
    one = int(np.argmax(np.asarray(tracking.scene.labels) == group))  # any Gaussian turns as its object does
    found = Rotation.from_quat(tracking.quats()[:, one], scalar_first=True)
    poses = truth.poses[: tracking.num_frames, truth.label_ids.tolist().index(label), :3, :3]
    true = Rotation.from_matrix(poses)
    apart = (found * found[0].inv()).inv() * (true * true[0].inv())
    return np.degrees(apart.magnitude())


def judge(
    errors: np.ndarray, turns: np.ndarray, pixels: np.ndarray, said: np.ndarray, unsure: np.ndarray
) -> dict[str, Any]:
    """What became of one object.

    Args:
        errors: of its centroid, millimetres, frame by frame.
        turns: errors of how it is turned, degrees.
        pixels: that truly show it.
        said: whether the tracker said that it is lost or unseen.
        unsure: whether it said that it does not know how the object is turned.
    """
    there = pixels >= FEWEST_PIXELS
    astray = (errors > ASTRAY_MM) & there
    wrongly = turns > TURNED_DEG
    told = said | (unsure & wrongly & (errors <= TURN_MM))
    silent = longest(astray & ~told)
    ends = bool(astray[there][-1])
    if not astray.any():
        verdict = "sound"
    elif silent > MOST_SILENT or not (astray & told).any():
        verdict = "astray, unsaid"
    elif not (astray & said).any():
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
        "unsaid": int((astray & ~told).sum()),
        "sound_frames": int(sound.sum()),
        "false_alarms": int((sound & said).sum()),
        "turn_right_frames": int((there & ~wrongly).sum()),
        "false_doubts": int((there & ~wrongly & unsure & ~said).sum()),
        "turns_deg": turns.round(1).tolist(),
        "errors_mm": errors.round(2).tolist(),
        "said": said.tolist(),
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
            errors, told = np.maximum(found["errors_mm"], 0.05), np.asarray(found["said"])
            there, frames = np.asarray(found["there"]), np.arange(len(errors))
            axes.plot(frames, np.where(there, errors, np.nan), color=f"C{i}", label=name, linewidth=1.5)
            axes.plot(frames, np.where(there, np.nan, errors), color=f"C{i}", linewidth=1, alpha=0.25)
            axes.plot(frames[told], errors[told], "o", color=f"C{i}", markersize=3.5)
        axes.axhline(ASTRAY_MM, color="#888888", linewidth=0.8, linestyle=":")
        axes.set(yscale="log", ylim=(0.05, 3000), yticks=(0.1, 1, 10, 100, 1000))
        axes.set_title(f"{row['case']}, {row['preset']}: {row['verdict']}", fontsize=9)
        axes.legend(fontsize=7, loc="upper left", ncols=2, frameon=False)
    drawing.supylabel("centroid error [mm]")
    drawing.supxlabel("frame")
    drawing.savefig(path, format=path.suffix.removeprefix(".") or "png")
