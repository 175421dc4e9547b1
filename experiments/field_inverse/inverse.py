"""Three ways to ask a field in 3D: exactly, by the pseudo-inverse of its convolution, by a learned one."""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # what experiments share

import jax
import jax.numpy as jnp
import numpy as np
from fields import codebook_of, fitted, flawed_teacher, learned, scored
from timing import jitted, median_ms, timed

from gsjax.cli.field_scene import scaled
from gsjax.methods.feature_field import (
    FieldConfig,
    back_projected_cosines,
    features_of,
    gaussian_cosines,
    learned_inverse,
    pseudo_inverse,
)

SCALE, ITERATIONS = 0.5, 200
_KEPT: dict[int, Any] = {}  # the field of each seed, distilled once


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One way, on articulated_0 with flawed masks at half of its resolution."""
    if seed not in _KEPT:
        scene = fitted("articulated_0", folder, eval_cameras=(3, 8), frames="0:1")
        names, codes = codebook_of(scene.photographs)
        teacher, _ = flawed_teacher(scene, codes, seed, scale=SCALE)
        config, small = FieldConfig(iterations=ITERATIONS, seed=seed), scaled(scene, SCALE)
        _KEPT[seed] = scene, names, jnp.asarray(codes), learned(small, scene.taught, teacher, config)
    scene, names, codes, found = _KEPT[seed]
    field, located, way = found.field, found.located, options["way"]
    features, inverse, made_ms = features_of(field, located), None, 0.0
    if way == "pseudo-inverse":
        inverse, made_ms = timed(pseudo_inverse, field.lift)
    elif way == "learned (eq. 9)":
        (inverse, _), made_ms = timed(learned_inverse, field.lift, features, jax.random.key(seed))
    if inverse is None:
        ask, error = jitted(gaussian_cosines), 0.0
        given = (field, located, codes)
    else:
        ask, given = jitted(back_projected_cosines), (field, located, codes, inverse)
        back = features @ field.lift.T @ inverse.T
        error = float(jnp.linalg.norm(back - features) / jnp.linalg.norm(features))
    cosines = np.asarray(ask(*given))
    exact = np.asarray(gaussian_cosines(field, located, codes)).argmax(1)
    return {
        **scored(scene, cosines.argmax(1), names),
        "cycle_error": error,
        "agreement": float((cosines.argmax(1) == exact).mean()),
        "made_ms": made_ms,
        "query_ms": median_ms(ask, *given),
    }
