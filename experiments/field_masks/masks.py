"""How well does a field reproduce flawed masks, in views and on Gaussians, against a plain vote?"""

from pathlib import Path
from typing import Any

from experiments.shared.fields import (
    NO_FLAWS,
    articulated,
    by_majority,
    codebook_of,
    first_tracked,
    flawed_teacher,
    learned,
    of_field,
    scored,
)
from gsjax.engine.distill.scene import FieldScene
from gsjax.methods.distill import DistillConfig


def scene_of(name: str, folder: Path) -> FieldScene:
    """The scene fitted to eight cameras; or, for recordings of few cameras, the tracker's first scene."""
    if name == "articulated_0":
        return articulated(folder)
    return first_tracked(name, folder, cameras=(0, 1), mask_camera=1, eval_cameras=(2,))


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Masks of one seed, lifted by a vote and distilled into a field; and a vote of the true masks as a
    bound."""
    scene = scene_of(options["scene"], folder)
    names, codes = codebook_of(scene.photographs)
    _, true = flawed_teacher(scene, codes, seed, NO_FLAWS)
    ceiling = scored(scene, by_majority(scene, scene.taught, true, len(names)), names)
    _, ids = flawed_teacher(scene, codes, seed)
    voted = scored(scene, by_majority(scene, scene.taught, ids, len(names)), names)
    teacher, snapped = flawed_teacher(scene, codes, seed, snap=options["snap"])
    of_snapped = scored(scene, by_majority(scene, scene.taught, snapped, len(names)), names)
    found = learned(scene, scene.taught, teacher, DistillConfig(iterations=options["iterations"], seed=seed))
    by_field = (found.field, found.located, codes)
    asked = scored(scene, of_field(found, codes), names, by_field)
    return {
        **asked,
        "voted_miou": voted["miou_3d"],
        "voted_inside_miou": voted["inside_miou_3d"],
        "voted_mboundary_iou": voted["mboundary_iou_3d"],
        "voted_gaussian_iou": voted["gaussian_iou"],
        "voted_hidden_recall": voted["hidden_recall"],
        "snapped_miou": of_snapped["miou_3d"],
        "snapped_mboundary_iou": of_snapped["mboundary_iou_3d"],
        "true_miou": ceiling["miou_3d"],
        "true_inside_miou": ceiling["inside_miou_3d"],
        "gaussians": scene.gaussians.num,
        "minutes": (found.seconds + found.compile_seconds) / 60,
    }
