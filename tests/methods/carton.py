"""The carton of the simulated table as alignment sees it, and how well points that stand for it fit."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from gsjax.methods.track import PRESETS
from gsjax.methods.track.align import disagreement
from gsjax.methods.track.points import tone_images

CONFIG = replace(PRESETS["accurate"].align, iterations=12)
CARTON = 2
SIZE = {"width": 160, "height": 120}


def see(frame):
    return tone_images(frame, CONFIG.shading)


def middle(points):
    """The mean of the points that count."""
    return (points.means * (points.seen[:, None] > 0)).sum((0, 2)) / (points.seen > 0).sum()


def gap(points, sight, config=CONFIG):
    """Disagreement of points where they are."""
    return float(disagreement(jnp.zeros(6), points, jnp.zeros(3), sight, config))


def error(points, means, then):
    seen = np.asarray(points.seen) > 0
    return np.linalg.norm(means - then, axis=1)[seen].mean()
