"""Three ways to query a field in 3D: exactly, by the pseudo-inverse of its convolution, by a learned
inverse."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.shared.fields import articulated, codebook_of, flawed_teacher, learned, scored
from experiments.shared.timing import jitted, median_ms, timed
from gsjax.engine.distill.scene import scaled
from gsjax.methods.distill import (
    DistillConfig,
    back_projected_cosines,
    features_of,
    gaussian_cosines,
    learned_inverse,
)

SCALE, ITERATIONS = 0.5, 200
_KEPT: dict[int, Any] = {}  # the field of each seed, distilled once


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One way, on articulated_0 with flawed masks at half resolution."""
    if seed not in _KEPT:
        scene = articulated(folder)
        names, codes = codebook_of(scene.photographs)
        teacher, _ = flawed_teacher(scene, codes, seed, scale=SCALE)
        config, small = DistillConfig(iterations=ITERATIONS, seed=seed), scaled(scene, SCALE)
        _KEPT[seed] = scene, names, jnp.asarray(codes), learned(small, scene.taught, teacher, config)
    scene, names, codes, found = _KEPT[seed]
    field, located, way = found.field, found.located, options["way"]
    features, inverse, made_ms, error = features_of(field, located), None, 0.0, None
    if way == "pseudo-inverse":
        made_ms = median_ms(jnp.linalg.pinv, field.lift)
        inverse = jnp.linalg.pinv(field.lift)
    elif way == "learned (eq. 9)":
        learn = partial(learned_inverse, field.lift, features[::2], jax.random.key(seed))
        timed(learn)  # compiles
        (inverse, _), made_ms = timed(learn)
    if inverse is None:
        ask, given = jitted(gaussian_cosines), (field, located, codes)
    else:
        ask, given = jitted(back_projected_cosines), (field, located, codes, inverse)
        others = features[1::2]  # held out from learning the inverse
        back = others @ field.lift.T @ inverse.T
        error = float(jnp.linalg.norm(back - others) / jnp.linalg.norm(others))
    cosines = np.asarray(ask(*given))
    exact = np.asarray(gaussian_cosines(field, located, codes)).argmax(1)
    return {
        **scored(scene, cosines.argmax(1), names),
        "cycle_error": error,
        "agreement": float((cosines.argmax(1) == exact).mean()),
        "made_ms": made_ms,
        "query_ms": median_ms(ask, *given),
    }
