"""How long does a distillation take, and how much memory, at the paper's number of iterations and beyond?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.shared.fields import articulated, codebook_of, flawed_teacher, learned, of_field, scored
from experiments.shared.timing import jitted, median_ms
from gsjax.data.photographs import Photographs
from gsjax.engine.distill.scene import FieldScene
from gsjax.methods.distill import DistillConfig, Teacher, gaussian_cosines
from gsjax.scene.gaussians import concatenate

ITERATIONS = 1500  # the paper's
FEW = 12  # steps where only time is measured, half of them with the contrast, as in a whole run


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """articulated_0 at 320x240 with 5.7e4 Gaussians, all iterations; or at twice the size, a few."""
    scene = articulated(folder)
    names, codes = codebook_of(scene.photographs)
    teacher, _ = flawed_teacher(scene, codes, seed, snap=2)
    iterations = ITERATIONS
    if options["size"] == "640x480":
        scene, teacher, iterations = _doubled(scene), _enlarged(teacher), FEW
    found = learned(scene, scene.taught, teacher, DistillConfig(iterations=iterations, seed=seed))
    asked = scored(scene, of_field(found, codes), names, (found.field, found.located, codes))
    step_s = found.seconds / iterations
    return {
        "gaussians": scene.gaussians.num,
        "step_ms": 1e3 * step_s,
        "paper_minutes": ITERATIONS * step_s / 60,
        "compile_s": found.compile_seconds,
        "memory_mb": found.memory_mb,
        "trained": found.trained,
        "query_ms": median_ms(jitted(gaussian_cosines), found.field, found.located, jnp.asarray(codes[:1])),
        "miou_2d": asked["miou_2d"] if iterations > FEW else None,
        "miou_3d": asked["miou_3d"] if iterations > FEW else None,
        "mboundary_iou_3d": asked["mboundary_iou_3d"] if iterations > FEW else None,
    }


def _doubled(scene: FieldScene) -> FieldScene:
    """Photographs of twice the size, and each Gaussian twice, a tenth of its size apart: 1.1e5 of them."""
    gaussians = scene.gaussians
    twin = replace(gaussians, means=gaussians.means + 0.1 * gaussians.scales)
    both = concatenate([gaussians, twin])
    return replace(scene, gaussians=both, photographs=_large(scene.photographs))


def _large(photographs: Photographs) -> Photographs:
    factors = np.array([2.0, 2.0, 1.0])

    def twice(load):
        return load and (lambda i: load(i).repeat(2, 0).repeat(2, 1))

    return replace(
        photographs,
        sizes=2 * photographs.sizes,
        Ks=photographs.Ks * factors[:, None],
        load_image=twice(photographs.load_image),
        load_labels=twice(photographs.load_labels),
        load_depth=twice(photographs.load_depth),
    )


def _enlarged(teacher: Teacher) -> Teacher:
    return teacher._replace(ids=[one.repeat(2, 0).repeat(2, 1) for one in teacher.ids])
