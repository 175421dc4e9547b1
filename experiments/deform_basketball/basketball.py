"""A real moving scene without depth, seen by one camera at a time or by all: are views learned that nobody
had?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gsjax
from experiments.shared.around import reconstructed, scores
from experiments.shared.deforming import one_frame
from experiments.shared.recordings import recorded
from gsjax.data import ReadOptions
from gsjax.engine.deform.data import unit_times
from gsjax.engine.deform.scores import draw
from gsjax.engine.drive import Drive
from gsjax.methods.deform import PRESETS
from gsjax.methods.deform.method import PLAN
from gsjax.metrics.image import psnr
from gsjax.scene.frame import Frame

HELD_OUT = (0, 10, 15, 30)  # the test cameras of Dynamic3DGaussians
SCALE, STEPS, POINTS = 0.5, 3000, 30_000
EVERY = 4  # times that are scored
MOVES = 0.1  # standard deviation of a pixel over time above which something moves there


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One reconstruction by a preset; a static one is all warm-up."""
    near = ReadOptions(near=0.5)  # cameras of the dome see each other
    sequence = gsjax.open_sequence(str(recorded("panoptic_basketball")), near).scaled(SCALE)
    times, ids = unit_times(sequence), sequence.camera_ids
    learners = [ids.index(camera) for camera in ids if camera not in HELD_OUT]

    def frame(t: int, c: int) -> Frame:
        pose = (sequence.viewmats[t, c], sequence.Ks[t, c])
        return one_frame(sequence.image(t, c), *pose, float(times[t]), near=sequence.near)

    moments = range(sequence.num_frames)
    views = {"one": [(t, learners[t % len(learners)]) for t in moments]}
    views["all"] = [(t, c) for t in moments for c in learners]
    learned, recipe = [frame(*view) for view in views[options["cameras"]]], options["recipe"]
    preset = replace(PRESETS["around"], warmup=STEPS, iterations=0) if recipe == "static" else PRESETS[recipe]
    ticks, took = reconstructed(learned, preset, STEPS, None, hull_points=POINTS, seed=seed)
    judged = [[frame(t, ids.index(camera)) for t in moments[::EVERY]] for camera in HELD_OUT]
    held_out = scores(ticks, [one for of_camera in judged for one in of_camera], None)
    return {
        "held_out": float(held_out[:, 0].mean()),
        "ssim": float(held_out[:, 1].mean()),
        "moving": _where_it_moves(ticks, judged),
        "learned": float(scores(ticks, learned[:: max(1, len(learned) // 30)], None)[:, 0].mean()),
        "pictures": len(learned),
        **took,
    }


def _where_it_moves(ticks: Drive, judged: list[list[Frame]]) -> float:
    """Mean PSNR of held-out pictures, where those of the same camera differ over time."""
    scene, moving, plan = ticks.result.scene, ticks.result.moving, ticks.run.plans[PLAN]
    found = []
    for frames in judged:
        true = np.stack([np.asarray(frame.colors[0]) for frame in frames])
        moves = true.std(axis=0).max(axis=-1) > MOVES
        for frame, picture in zip(frames, true, strict=True):
            drawn = draw(scene, moving, frame, plan).colors.reshape(picture.shape)
            found.append(psnr(drawn, picture, moves))
    return float(np.mean(found))
