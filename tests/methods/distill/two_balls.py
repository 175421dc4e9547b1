"""Two balls of Gaussians, with true masks of eight cameras around them, from which fields learn."""

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import Camera
from gsjax.methods.distill import frozen_views
from gsjax.rasterize.frozen import paint
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from tests.methods.around import cameras_around

WIDTH, HEIGHT, DIMENSION = 48, 36, 24
BOOK = np.linalg.qr(np.random.default_rng(0).normal(size=(DIMENSION, 3)))[0].T.astype(np.float32)
"""Embeddings of the background and of each ball."""

painted = jax.jit(paint, static_argnames="plan")


def cameras(count: int) -> list[Camera]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return cameras_around(angles, WIDTH, HEIGHT)


def two_balls() -> tuple[Gaussians, np.ndarray, list[np.ndarray]]:
    """(two balls of Gaussians, the label of each Gaussian, 1 or 2, and the masks of eight cameras)."""
    random = np.random.default_rng(1)
    directions = random.normal(size=(160, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centres = np.repeat([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], 80, axis=0)
    scene = gaussians_from_activated(
        centres + 0.35 * directions,
        random.normal(size=(160, 4)),
        np.full((160, 3), 0.07),
        np.full(160, 0.95),
        random.uniform(size=(160, 3)),
    )
    labels = np.repeat([1, 2], 80)
    masks = []
    for view, plan in frozen_views(scene, cameras(8)):
        shares = np.asarray(painted(view, jnp.eye(3)[labels], plan)[0])
        masks.append(np.where(shares.sum(-1) > 0.5, shares.argmax(-1), 0))
    return scene, labels, masks
