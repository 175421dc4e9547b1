"""Unseen Gaussians move with those around them: the strain between the nodes of a deforming scene."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.deform import Deform, nodes_of, start_gaussians
from gsjax.methods.deform.method import batch_of
from gsjax.methods.deform.update import deform_loss
from gsjax.optim.method import Run
from tests.methods.deform.tissue import CONFIG, tissue


@pytest.fixture(scope="module")
def begun() -> tuple:
    """A problem, and its run when deformation begins."""
    method = Deform(replace(CONFIG, warmup=0, nodes=64))
    problem, run = method.start(tissue()[0])
    return problem, method.between(problem, run, 0.0)


def with_bias(run: Run, bias) -> Run:
    """The run with constant offsets added to the field: of means, rotations and sizes."""
    bias = jnp.asarray(bias, jnp.float32)
    return run.having(params=eqx.tree_at(lambda p: p.field.layers[-1].bias, run.params, bias))


def strain_of(begun, run: Run) -> float:
    problem, _ = begun
    config = replace(CONFIG, warmup=0, nodes=64)
    _, info = jax.jit(deform_loss(config))(run.params, batch_of(problem, run, 1), step=0, key=0)
    return float(info["rigid"]) / config.weights.rigidity


@pytest.mark.thorough
def test_a_scene_that_moves_or_grows_as_one_has_none(begun):
    _, run = begun
    bias = np.zeros(len(run.params.field.layers[-1].bias))
    assert strain_of(begun, run) == 0
    bias[:3] = 0.1, -0.2, 0.3  # units of the longest edge of the bounding box
    assert strain_of(begun, with_bias(run, bias)) < 1e-4


@pytest.mark.thorough
def test_turning_in_place_is_strained_as_neighbours_do_not_follow(begun):
    """Each node rotates by half a turn while its neighbours stay: edges have strains of up to 2."""
    _, run = begun
    bias = np.zeros(len(run.params.field.layers[-1].bias))
    bias[3] = np.pi
    assert 0.5 < strain_of(begun, with_bias(run, bias)) < 2


@pytest.mark.thorough
def test_without_nodes_or_weight_there_is_no_such_loss(begun):
    problem, run = begun
    for config, kept in ((replace(CONFIG, nodes=0), run.kept._replace(moving=None)), (None, run.kept)):
        config = config or replace(CONFIG, weights=replace(CONFIG.weights, rigidity=0.0))
        params = run.having(kept=kept)
        _, info = jax.jit(deform_loss(config))(run.params, batch_of(problem, params, 1), step=0, key=0)
        assert "rigid" not in info


@pytest.mark.thorough
def test_groups_of_few_have_no_neighbours_in_others():
    gaussians = start_gaussians(tissue()[0], 0, 2.0)
    groups = np.repeat([0, 1], [gaussians.num - 3, 3])
    nodes = nodes_of(gaussians, 8, groups)
    neighbors = np.asarray(nodes.indices)[np.asarray(nodes.rows)]
    group = groups[np.asarray(nodes.rows)]
    np.testing.assert_array_equal(group[neighbors], np.broadcast_to(group[:, None], neighbors.shape))
