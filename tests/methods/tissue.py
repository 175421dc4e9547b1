"""Looks at the built-in tissue, codes for what they show, and a scene that learns them within seconds."""

from functools import cache

import numpy as np

import gsjax
from gsjax.methods.deform import DeformConfig, DeformRatesConfig, GraphConfig, Look
from gsjax.scene.deformation import DeformationConfig

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
def tissue_looks():
    """Every other frame of built-in tissue, tools left out, and what each pixel shows."""
    seen = gsjax.open_sequence("simulated:tissue?width=64&height=52&frames=10").select(range(0, 10, 2), (0,))
    return [look._replace(ids=seen.mask(t, 0)) for t, look in enumerate(looks_of(seen))]


def looks_of(seen):
    """The first camera's, tools left out."""
    return [
        Look(
            seen.image(t, 0),
            seen.mask(t, 0) == 0,
            seen.depth(t, 0),
            seen.viewmats[t, 0],
            seen.Ks[t, 0],
            t / (seen.num_frames - 1),
        )
        for t in range(seen.num_frames)
    ]
