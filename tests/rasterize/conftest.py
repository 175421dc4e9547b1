"""Fixtures: small scenes, and the arguments of `gsjax.plan` taken from them."""

import dataclasses

import numpy as np
import pytest

from benchmarks.scenes import ARRAYS, Case, case, cast, make_scene
from gsjax.rasterize.plan import DEFAULT_LIMITS


@pytest.fixture(scope="session")
def small():
    """make(seed, **case fields) -> (case, scene in float32): 40 Gaussians on 33 x 17 pixels by default."""

    def make(seed: int = 0, dtype=np.float32, **fields) -> tuple[Case, dict]:
        plain = {"width": 33, "height": 17, "render_mode": "RGB", "rasterize_mode": "classic"}
        plain |= {"sh_degree": None, "channels": 3, "feature_channels": None, "limits": DEFAULT_LIMITS}
        this = dataclasses.replace(case(seed, 40), **plain | fields)
        return this, {k: v for k, v in cast(make_scene(this), dtype).items() if v is not None}

    return make


@pytest.fixture(scope="session")
def geometry():
    """The arguments of `gsjax.plan` from a scene."""
    names = (*ARRAYS[:4], "viewmats", "Ks")
    return lambda scene: tuple(scene[name] for name in names)
