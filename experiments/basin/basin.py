"""How far off may an object start? Displaced by so much, does the gradient lead home, and who gets there?

The scene is fitted to the first frame; the images are of the next one, whose true motion is known. Both
objects start from their true places there, displaced alike: they are too far apart to meet.
"""

from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from experiments.basin.boxes import OBJECTS, PIXELS_PER_MM, boxes
from experiments.optimizers import methods
from experiments.shared.one_update import Update, scene_at, update_of
from gsjax.methods.track.align import compose
from gsjax.methods.track.config import RefineConfig
from gsjax.methods.track.motion import Motion
from gsjax.methods.track.points import carry
from gsjax.methods.track.refine import RefineBatch, refine_loss, refine_residual
from gsjax.metrics.tracking import relative_motion

HOME_MM = 3.0
BLOCK = 8  # edge of the blocks that differences are averaged over, pixels
ITERATIONS, TRANSLATION_RATE, ROTATION_RATE = 32, 8e-3, 0.15  # Adam's: it can go 100 mm and 110 degrees
PHOTOMETRIC = RefineConfig(depth_weight=0.0, color_limit=1.0)
WITH_DEPTH = RefineConfig()
DIRECTIONS = jaxlie.SO3.exp(jnp.array([0.3, 0.5, 0.2])).as_matrix() @ (
    jnp.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]).T / jnp.sqrt(3.0)
)


@cache
def problem() -> tuple[Update, Float[Array, "k 6"]]:
    """The update, and its true twists."""
    sequence = boxes()
    update = update_of(sequence, scene_at(sequence, 0, 1), 0, 1, least_mm=0.0, reach=0.08)
    home = []
    for center, poses in zip(np.asarray(update.batch.centers), update.poses.values(), strict=True):
        motion = relative_motion(poses)[1]
        turn = jaxlie.SO3.from_matrix(jnp.asarray(motion[:3, :3])).log()
        home.append(np.concatenate([motion[:3, :3] @ center + motion[:3, 3] - center, turn]))
    return update, jnp.asarray(np.array(home), jnp.float32)


@partial(methods.jitted, static_argnames="config")
def downhill(motion: Motion, batch: RefineBatch, config: RefineConfig) -> Motion:
    """Against the gradient."""
    loss = partial(refine_loss, batch=batch, step=0, key=None, config=config)
    return jax.tree.map(jnp.negative, jax.grad(loss, has_aux=True)(motion)[0])


@methods.jitted
def downhill_of_blocks(motion: Motion, batch: RefineBatch) -> Motion:
    """The same where differences are averaged over blocks of pixels before they count."""

    def loss(motion):
        rotations = jaxlie.SO3.exp(motion.twists[:, 3:])
        motions = jaxlie.SE3.from_rotation_and_translation(rotations, motion.twists[:, :3])
        residuals, _ = refine_residual(motions, batch, step=0, key=None, config=PHOTOMETRIC, block=BLOCK)
        return jnp.sum(residuals["color"] ** 2)

    return jax.tree.map(jnp.negative, jax.grad(loss)(motion))


def cosine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Along the last axis; 0 where a vector is."""
    return np.sum(a * b, -1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-30)


def displaced(home: Float[Array, "k 6"], motion: str, amount: float) -> list[Float[Array, "k 6"]]:
    """The true twists with so much (mm or degrees) of shift or turn behind them, to all sides."""
    change = jnp.zeros((DIRECTIONS.shape[1], 6))
    if motion == "translation":
        change = change.at[:, :3].set(1e-3 * amount * DIRECTIONS.T)
    else:
        change = change.at[:, 3:].set(jnp.deg2rad(amount) * DIRECTIONS.T)
    return [compose(jnp.broadcast_to(one, home.shape), home) for one in change]


@cache
def measured(motion: str, amount: float) -> dict[str, dict[str, float]]:
    """Of each object, means over the directions."""
    update, home = problem()
    batch, delta = update.batch, methods.standing(update).delta
    groups = np.asarray(batch.scene.labels[: batch.scene.num_moving]) - 1
    part = slice(0, 3) if motion == "translation" else slice(3, 6)
    rates = Motion(jnp.repeat(jnp.array([TRANSLATION_RATE, ROTATION_RATE]), 3), jnp.array(0.0))
    still = jnp.zeros_like(home)
    rows = []
    for start in displaced(home, motion, amount):
        begun, way = Motion(start, delta), np.asarray(home - start)[:, part]
        # Alignment looks around where objects were, so for it they were there.
        points, centers = jax.vmap(carry)(update.points, start, batch.centers), batch.centers + start[:, :3]
        given = (still, points, centers, batch.frame)
        slopes = {
            "photometric": downhill(begun, batch, PHOTOMETRIC),
            "blocks": downhill_of_blocks(begun, batch),
            "depth": downhill(begun, batch, WITH_DEPTH),
        }
        downward = {name: np.asarray(slope.twists)[:, part] for name, slope in slopes.items()}
        row = {f"cos_{name}": cosine(slope, way) for name, slope in downward.items()}
        if motion == "translation":
            single = np.asarray(slopes["photometric"].delta)
            felt = np.linalg.norm(single, axis=-1) > 0
            each = cosine(single, way[groups])
            row["cos_single"] = np.array([each[felt & (groups == k)].mean() for k in range(len(home))])
        ends = {
            "adam": methods.descend(begun, batch, rates, ITERATIONS, PHOTOMETRIC),
            "adam_depth": methods.descend(begun, batch, rates, ITERATIONS, WITH_DEPTH),
            "align": Motion(compose(methods.aligned(*given), start), delta),
            "search": Motion(compose(methods.searched(*given), start), delta),
        }
        rows.append(row | {f"home_{name}": arrived(update, end) for name, end in ends.items()})
    means = {name: np.mean([row[name] for row in rows], axis=0) for name in rows[0]}
    return {who: {name: float(mean[k]) for name, mean in means.items()} for k, who in enumerate(OBJECTS)}


def arrived(update: Update, motion: Motion) -> np.ndarray:
    """Whether each object's mean point error is below HOME_MM."""
    return np.array([2 * score.point_error_mm < HOME_MM for score in update.scores(motion)], float)


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One object, displaced by one amount; both objects run with the first."""
    found = measured(options["motion"], options["amount"])[options["object"]]
    pixels = options["amount"] * PIXELS_PER_MM if options["motion"] == "translation" else None
    return {"pixels": pixels, "starts": DIRECTIONS.shape[1], **found}


def figure(rows: list[dict[str, Any]], path: Path) -> None:
    """Cosines and shares over the displacement, a row of panels for each motion."""
    from experiments.shared.plots import draw_basin

    draw_basin(rows, path, PIXELS_PER_MM)
