"""The carton of the simulated table as alignment sees it, and how well its points fit."""

from dataclasses import replace

import jax
import numpy as np

from gsjax.methods.track import PRESETS
from gsjax.methods.track.align import disagreement
from gsjax.methods.track.points import tone_images

CONFIG = replace(PRESETS["accurate"].align, iterations=12)
CARTON = 2
SIZE = {"width": 160, "height": 120}


@jax.jit
def see(frame):
    return tone_images(frame, CONFIG.shading)


@jax.jit
def middle(points):
    """The mean of the points that are seen."""
    return (points.means * (points.seen[:, None] > 0)).sum((0, 2)) / (points.seen > 0).sum()


def gap(points, sight, config=CONFIG):
    """The disagreement of points at their present positions."""
    return float(_disagreement(np.zeros(6, np.float32), points, np.zeros(3, np.float32), sight, config))


_disagreement = jax.jit(disagreement, static_argnums=4)


def error(points, means, then):
    seen = np.asarray(points.seen) > 0
    return np.linalg.norm(means - then, axis=1)[seen].mean()
