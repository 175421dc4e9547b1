"""Frames of the built-in tissue, codes of its classes, and a configuration that trains within seconds."""

from functools import cache

import numpy as np

import gsjax
from gsjax.geometry.cameras import Camera
from gsjax.methods.deform import DeformConfig, DeformRatesConfig, GraphConfig, Lesson
from gsjax.scene.deformation import DeformationConfig
from gsjax.scene.frame import Frame

CODES = np.eye(2, 4)
TINY = DeformationConfig(resolution=16, time_resolution=6, levels=1, channels=4, hidden=16)
CONFIG = DeformConfig(
    warmup=8,
    iterations=70,
    start_pixels=1.0,
    nodes=64,
    channels=4,
    rates=DeformRatesConfig(planes=3e-2, layers=1e-2, features=3e-2),
    deformation=TINY,
    graph=GraphConfig(nodes=24, neighbors=3, matches=2, window=1),
)


@cache
def tissue():
    """(every other frame of built-in tissue with tools masked, a lesson with the class of each pixel)."""
    seen = gsjax.open_sequence("simulated:tissue?width=64&height=52&frames=10").select(range(0, 10, 2), (0,))
    return frames_of(seen), Lesson([seen.mask(t, 0) for t in range(seen.num_frames)], CODES)


def frames_of(seen):
    """Frames of the first camera, with tools masked."""
    last = seen.num_frames - 1
    return [
        one_frame(
            seen.image(t, 0),
            seen.viewmats[t, 0],
            seen.Ks[t, 0],
            t / last,
            seen.depth(t, 0),
            seen.mask(t, 0) == 0,
        )
        for t in range(seen.num_frames)
    ]


def one_frame(image, viewmat, K, time, depth=None, mask=None):
    """A frame of one camera, on the host."""
    height, width = image.shape[:2]
    return Frame(
        image[None],
        None if depth is None else depth[None],
        Camera(viewmat[None], K[None], width, height),
        None if mask is None else mask[None],
        np.asarray(float(time)),
    )
