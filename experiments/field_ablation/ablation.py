"""What is each part of the distillation worth? One is left out or replaced at a time."""

from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.field_ablation.autoencoder import trained
from experiments.shared.fields import (
    Learned,
    articulated,
    codebook_of,
    flawed_teacher,
    learned,
    of_field,
    scored,
)
from gsjax.engine.distill.scene import FieldScene, scaled
from gsjax.methods.distill import DistillConfig, DistillWeightsConfig, Teacher, features_of
from gsjax.methods.distill.field import FeatureField

SCALE, ITERATIONS = 0.5, 100
BASE = DistillConfig(iterations=ITERATIONS)
NEITHER = replace(BASE, weights=DistillWeightsConfig(contrast=0.0, tv=0.0))
VARIANTS: dict[str, DistillConfig] = {
    "all on": BASE,
    "without contrast": replace(BASE, weights=DistillWeightsConfig(contrast=0.0)),
    "without TV": replace(BASE, weights=DistillWeightsConfig(tv=0.0)),
    "without both": NEITHER,
    "a vector each, not the hash grid": replace(BASE, encoding="table"),
    "a vector each, without both": replace(NEITHER, encoding="table"),
}
SQUEEZED = {"autoencoder to 8, without both": 8, "autoencoder to 16, without both": 16}


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One variant on articulated_0 with flawed masks at half resolution, scored at full resolution."""
    whole = articulated(folder)
    names, codes = codebook_of(whole.photographs)
    teacher, _ = flawed_teacher(whole, codes, seed, scale=SCALE)
    scene = scaled(whole, SCALE)
    variant = options["variant"]
    squeezed, aside, more = variant in SQUEEZED, 0.0, 0
    if squeezed:
        found, aside, more = _squeezed(scene, teacher, SQUEEZED[variant], seed)
    else:
        found = learned(scene, scene.taught, teacher, replace(VARIANTS[variant], seed=seed))
    by_pixel = None if squeezed else (found.field, found.located, codes)
    asked = scored(whole, of_field(found, codes), names, by_pixel)
    return {
        **asked,
        "miou_2d": None if squeezed else asked["miou_2d"],
        "step_ms": 1e3 * found.seconds / (ITERATIONS - 1),
        "minutes": (found.seconds + found.compile_seconds + aside) / 60,
        "memory_mb": found.memory_mb,
        "trained": found.trained + more,
    }


def _squeezed(scene: FieldScene, teacher: Teacher, size: int, seed: int) -> tuple[Learned, float, int]:
    """A code for each Gaussian, distilled from the embeddings' codes and decoded before the query in 3D; the
    seconds of training the autoencoder, and the number of its weights.

    LangSplat decodes rendered codes, a 2D query unlike ours, so there is no 2D query here.
    """
    assert teacher.codebook is not None
    begun = perf_counter()
    model, _ = trained(teacher.codebook, size, seed)
    codes = np.asarray(model.encode(jnp.asarray(teacher.codebook)))
    aside = perf_counter() - begun
    weights = DistillWeightsConfig(rec=1000.0 / 512 * size, contrast=0.0, tv=0.0)  # the same loss per pixel
    config = replace(NEITHER, encoding="table", channels=size, weights=weights, seed=seed)
    found = learned(scene, scene.taught, teacher._replace(codebook=codes), config)
    low = features_of(found.field, None) @ found.field.lift.T
    features = model.decode(low)
    features /= jnp.linalg.norm(features, axis=-1, keepdims=True)
    decoded = FeatureField(features, jnp.eye(features.shape[1]))
    weights = sum(leaf.size for leaf in jax.tree.leaves(eqx.filter(model, eqx.is_array)))
    return replace(found, field=decoded), aside, weights


PANELS = (
    ("miou_3d", "mIoU, 3D query"),
    ("mboundary_iou_3d", "boundary mIoU"),
    ("gaussian_iou", "IoU of Gaussians"),
    ("step_ms", "milliseconds a step"),
)


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """A panel for each score, a bar for each variant."""
    from experiments.shared.plots import draw_ablation

    draw_ablation(rows, PANELS, path)
