"""Does a distillation stay finite with extreme settings, teachers and scenes?"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from experiments.shared.fields import articulated, codebook_of, flawed_teacher, true_labels
from gsjax.engine.distill.scene import FieldScene, scaled
from gsjax.engine.drive import drive
from gsjax.methods.distill import (
    Distill,
    DistillConfig,
    DistillRatesConfig,
    DistillWeightsConfig,
    Teacher,
    teacher_of_objects,
)
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.gaussians import take

SCALE = 0.25
BASE = DistillConfig(iterations=40, contrast_after=0.25)
ONE_LEVEL = FeatureGridConfig(levels=1, least_resolution=16, most_resolution=16)


def _with_means(scene: FieldScene, means: Any) -> FieldScene:
    return replace(scene, gaussians=eqx.tree_at(lambda g: g.means, scene.gaussians, means))


def _first(scene: FieldScene, count: int) -> FieldScene:
    return replace(scene, gaussians=take(scene.gaussians, np.arange(count)))


def _flat(scene: FieldScene) -> FieldScene:
    return _with_means(scene, scene.gaussians.means.at[:, 2].set(0.0))


def _far(scene: FieldScene) -> FieldScene:
    return _with_means(scene, scene.gaussians.means.at[0].set(jnp.array([1e6, 0.0, 0.0])))


def _unplaced(scene: FieldScene) -> FieldScene:
    return _with_means(scene, scene.gaussians.means.at[:100].set(jnp.nan))


def _teacher(change: Any) -> Any:
    return lambda scene, teacher, config: (scene, change(teacher), config)


def _scene(change: Any) -> Any:
    return lambda scene, teacher, config: (change(scene), teacher, config)


def _config(**settings: Any) -> Any:
    return lambda scene, teacher, config: (scene, teacher, replace(config, **settings))


CASES: dict[str, Any] = {
    "as it is": _config(),
    "one channel": _config(channels=1),
    "a table of 8 entries": _config(grid=FeatureGridConfig(log2_entries=3)),
    "one level": _config(grid=ONE_LEVEL),
    "rates a thousand times as high": _config(rates=DistillRatesConfig(table=10.0, layers=2.0, lift=2.0)),
    "weight of the difference 1e9": _config(weights=DistillWeightsConfig(rec=1e9)),
    "gamma of the contrast 1e4": _config(contrast_gamma=1e4),
    "contrast alone": _config(weights=DistillWeightsConfig(rec=0.0, cos=0.0, tv=0.0)),
    "strips of one row of tiles": _config(strip_megabytes=0.1),
    "embeddings of length 1e6": _teacher(lambda t: _longer(t, 1e6)),
    "embeddings of length 1e-6": _teacher(lambda t: _longer(t, 1e-6)),
    "one embedding 1e6 times as long": _teacher(
        lambda t: _longer(t, np.r_[1e6, np.ones(len(t.codebook) - 1)])
    ),
    "all embeddings alike": _teacher(lambda t: t._replace(codebook=np.ones_like(t.codebook))),
    "one pixel taught": _teacher(lambda t: t._replace(ids=[_one_pixel(ids) for ids in t.ids])),
    "one Gaussian": _scene(lambda scene: _first(scene, 1)),
    "a flat scene": _scene(_flat),
    "a Gaussian 1000 km away": _scene(_far),
    "100 Gaussians without a place": _scene(_unplaced),
}


def _longer(teacher: Teacher, factors: Any) -> Teacher:
    rows = (np.asarray(factors).reshape(-1, 1) * teacher.codebook).astype(np.float32)
    return teacher_of_objects(teacher.ids, [rows] * len(teacher.ids))


def _one_pixel(ids: np.ndarray) -> np.ndarray:
    found = np.full_like(ids, -1)
    found[len(ids) // 2, len(ids[0]) // 2] = max(0, ids[len(ids) // 2, len(ids[0]) // 2])
    return found


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """Forty steps of one case at a quarter of the resolution, and a query for all Gaussians."""
    scene = articulated(folder)
    _, codes = codebook_of(scene.photographs)
    teacher, _ = flawed_teacher(scene, codes, seed, scale=SCALE)
    scene = scaled(scene, SCALE)
    assert isinstance(teacher, Teacher)
    scene, teacher, config = CASES[options["case"]](scene, teacher, BASE)
    cameras = [scene.photographs.camera(i) for i in scene.taught]
    method = Distill(config)
    ticks = drive(method, *method.start(scene.gaussians, cameras, teacher, scene.rasterize_mode))
    losses, skipped = [], 0
    for now in ticks:
        losses.append(float(now.info["loss"]))
        skipped += bool(now.info["skipped"])
    field, cosines = ticks.result.field, np.asarray(ticks.result.cosines(codes))
    labels = true_labels(scene.gaussians, scene.photographs)
    right = (cosines.argmax(1) == labels)[labels > 0]
    placed = np.isfinite(np.asarray(scene.gaussians.means)).all(axis=1)
    return {
        "finite_losses": float(np.isfinite(losses).mean()),
        "skipped": skipped,
        "first_loss": losses[0],
        "last_loss": losses[-1],
        "finite_field": float(np.mean([np.isfinite(leaf).all() for leaf in jax.tree.leaves(field)])),
        "finite_cosines": float(np.isfinite(cosines[placed]).mean()),
        "right": float(right.mean()) if len(right) else None,
        "largest_cosine": float(np.abs(cosines[placed]).max()),
    }
