"""A warning names parts that move farther than the scene is wide."""

import io

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from gsjax.engine.messages import Notes
from gsjax.engine.parts.scoring import warn_of_runaways
from gsjax.methods.parts import PartScene
from gsjax.scene.initialize import gaussians_from_points


@pytest.mark.parametrize("moved_mm", [900.0, 5000.0])
def test_a_part_that_moves_farther_than_the_scene_is_wide_is_warned_of(moved_mm):
    means = np.random.default_rng(0).uniform(size=(500, 3))  # in a cube of one metre, but for two
    means[0] = 100.0
    means[1] = np.nan
    gaussians = gaussians_from_points(means, means[:, ::-1].clip(0, 1))
    scene = PartScene(gaussians, jnp.ones((500, 1)), jnp.zeros((1, 3)))
    rows = [
        {"part": 1, "gaussians": 400, "moved_mm": 300.0},
        {"part": 2, "gaussians": 38, "moved_mm": moved_mm},
    ]
    with Notes(Console(file=io.StringIO())) as notes:
        warn_of_runaways(rows, scene, notes)
        assert len(notes.all) == (moved_mm > 2000)
        assert all("2 (38 Gaussians)" in one for one in notes.all)
