"""A moving object before white, drawn in D-NeRF's layout: 150 frames learned, one for each time."""

from pathlib import Path
from typing import Any

from experiments.shared.around import reconstructed, scores
from experiments.shared.deforming import one_frame
from gsjax.data.ordered import open_as_sequence
from gsjax.engine.deform.data import unit_times
from gsjax.methods.deform import PRESETS
from gsjax.scene.frame import Frame
from tests.data.moving_object import write_dnerf

SIZE, COUNTS = 100, {"train": 150, "val": 2, "test": 20}
EVERY = 5  # of the learned frames, one in as many is scored


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One reconstruction by a preset, in a number of steps."""
    write_dnerf(folder / "object", SIZE, COUNTS)
    sequence = open_as_sequence(str(folder / "object"))
    frames: dict[str, list[Frame]] = {split: [] for split in COUNTS}
    for t, (split, time) in enumerate(zip(sequence.splits, unit_times(sequence), strict=True)):
        pose = (sequence.viewmats[t, 0], sequence.Ks[t, 0])
        frames[split].append(one_frame(sequence.image(t, 0), *pose, float(time)))
    preset, background = PRESETS[options["preset"]], sequence.background
    ticks, took = reconstructed(frames["train"], preset, options["steps"], background, seed=seed)
    held_out = scores(ticks, frames["test"], background)
    return {
        "held_out": float(held_out[:, 0].mean()),
        "worst": float(held_out[:, 0].min()),
        "ssim": float(held_out[:, 1].mean()),
        "learned": float(scores(ticks, frames["train"][::EVERY], background)[:, 0].mean()),
        **took,
    }
