"""What are FD-3DGS's losses worth once the rest has converged? One is left out or changed at a time, in a
field that begins as the least-squares solution."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.field_ladder.ladder import SNAP, trained
from experiments.shared.fields import articulated, codebook_of, flawed_teacher, scored
from gsjax.engine.distill.scores import classes_of
from gsjax.methods.distill import PRESETS, DistillConfig, DistillWeightsConfig

FIELD = PRESETS["field"]
NEITHER = DistillWeightsConfig(contrast=0.0, tv=0.0)
LONG = 300
VARIANTS: dict[str, DistillConfig] = {
    "all on": FIELD,
    "without contrast": replace(FIELD, weights=DistillWeightsConfig(contrast=0.0)),
    "contrast from the first step": replace(FIELD, contrast_after=0.0),
    "without TV": replace(FIELD, weights=DistillWeightsConfig(tv=0.0)),
    "without both": replace(FIELD, weights=NEITHER),
    "all on, 300 steps": replace(FIELD, iterations=LONG),
    "without both, 300 steps": replace(FIELD, iterations=LONG, weights=NEITHER),
}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One variant on articulated_0 with flawed masks, outlines on edges, as in `field_ladder`."""
    scene = articulated(folder)
    names, codes = codebook_of(scene.photographs)
    teacher, _ = flawed_teacher(scene, codes, seed, snap=SNAP)
    result, found = trained(scene, teacher, replace(VARIANTS[options["variant"]], seed=seed))
    field, located = result.placed
    return scored(scene, classes_of(field, located, codes), names, (field, located, codes)) | found


PANELS = (
    ("miou_3d", "mIoU, 3D query"),
    ("mboundary_iou_3d", "boundary mIoU"),
    ("gaussian_iou", "IoU of Gaussians"),
    ("hidden_recall", "hidden Gaussians"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, a bar for each variant."""
    from experiments.shared.plots import draw_ablation

    draw_ablation(rows, PANELS, path)
