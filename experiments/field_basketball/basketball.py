"""Foreground in a dome of real cameras, from a field whose training left four of them out."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.shared.fields import by_majority, codebook_of, fitted, learned, of_field, scored
from gsjax.data import ReadOptions
from gsjax.methods.distill import DistillConfig, teacher_of_objects
from gsjax.methods.fit import FitConfig, StartConfig

WITHHELD = (4, 12, 20, 27)  # cameras whose masks are used for scores only
HELD_OUT = (0, 10, 15, 30)  # cameras that the scene is not fitted to; they have no masks
FIT = FitConfig(steps=4_000, cap=30_000, sh_degree=0, start=StartConfig(count=20_000))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Real masks of 23 cameras, both distilled and lifted by a vote."""
    scene = fitted(
        "panoptic_basketball",
        folder,
        eval_cameras=HELD_OUT,
        fit=replace(FIT, seed=seed),
        frames="0:1",
        scale=0.5,
        read=ReadOptions(near=0.5),  # cameras of the dome see each other
    )
    photographs = scene.photographs
    cameras = [int(name.split("/")[0]) for name in photographs.names]
    masked = [i for i in scene.taught if photographs.labels(i) is not None]
    judges = [i for i in masked if cameras[i] in WITHHELD]
    taught = [i for i in masked if cameras[i] not in WITHHELD]
    scene = replace(scene, taught=taught, held_out=judges)
    names, codes = codebook_of(photographs.select(masked))
    masks = [np.asarray(photographs.labels(i), np.int64) for i in taught]
    teacher = teacher_of_objects(masks, [codes] * len(masks))
    voted = scored(scene, by_majority(scene, taught, masks, len(names)), names)
    found = learned(scene, taught, teacher, DistillConfig(iterations=options["iterations"], seed=seed))
    asked = scored(scene, of_field(found, codes), names, (found.field, found.located, codes))
    return {
        **asked,
        "voted_miou": voted["miou_3d"],
        "voted_mboundary_iou": voted["mboundary_iou_3d"],
        "things": asked["things"],
        "taught": len(taught),
        "judges": [f"{cameras[i]}" for i in judges],
        "gaussians": scene.gaussians.num,
        "minutes": (found.seconds + found.compile_seconds) / 60,
    }
