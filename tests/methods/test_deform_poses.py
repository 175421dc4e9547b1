"""Poses that are refined while a deforming scene is learned."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.io.checkpoints import load_checkpoint, save_checkpoint
from gsjax.methods.deform import (
    DeformConfig,
    DeformingScene,
    DeformRatesConfig,
    begin_deform,
    deform_loss,
    of_step,
    reconstruct,
    refined_viewmats,
)
from gsjax.scene.deformation import DeformationConfig
from tests.methods.tissue import looks_of

TINY = DeformationConfig(resolution=16, time_resolution=4, levels=1, channels=4, hidden=16)
CONFIG = DeformConfig(
    warmup=3,
    iterations=5,
    start_pixels=1.0,
    nodes=64,
    deformation=TINY,
    rates=DeformRatesConfig(planes=1e-2, twists=3e-3),
    refine_poses=True,
)


def off_by(viewmat, twist):
    """A view matrix whose camera is turned (degrees) about its centre, and shifted (metres)."""
    rotation = viewmat[:3, :3] @ Rotation.from_rotvec(np.deg2rad(twist[:3])).as_matrix().T
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, -rotation @ (center(viewmat) + twist[3:])
    return found


def center(viewmat):
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def turned(one, other):
    """Degrees."""
    return np.rad2deg(Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude())


@pytest.fixture(scope="module")
def looks():
    """Built-in tissue that stands still, tools left out."""
    seen = gsjax.open_sequence("simulated:tissue?width=40&height=32&frames=4&still=true").select(cameras=(0,))
    return looks_of(seen)


@pytest.fixture(scope="module")
def askew(looks):
    """The same, all but the first from somewhat elsewhere than they say: by 1 degree and 1.5 mm."""
    random = np.random.default_rng(0)
    twists = random.normal(size=(len(looks), 6)) * np.repeat([0.6, 0.9e-3], 3)
    twists[0] = 0
    return [
        look._replace(viewmat=off_by(look.viewmat, twist)) for look, twist in zip(looks, twists, strict=True)
    ]


def corners_off(found, looks):
    """Pixels by which points are seen elsewhere: turns and shifts of a camera look much alike."""
    offs = []
    for viewmat, look in zip(found, looks, strict=True):
        pixels = np.array([[5, 5, 1], [35, 5, 1], [20, 16, 1], [5, 27, 1], [35, 27, 1]], float)
        points = np.median(look.depth) * pixels @ np.linalg.inv(look.K).T
        world = (points - look.viewmat[:3, 3]) @ look.viewmat[:3, :3]
        there = (world @ viewmat[:3, :3].T + viewmat[:3, 3]) @ look.K.T
        offs.append(np.linalg.norm(there[:, :2] / there[:, 2:] - pixels[:, :2], axis=1).mean())
    return np.array(offs)


@pytest.fixture(scope="module")
def learned(askew):
    problem, state = begin_deform(askew, CONFIG)
    for found in reconstruct(problem, state):
        state = found.state
    return problem, state


def found_viewmats(problem, state):
    given = np.stack([look.viewmat for look in problem.looks])[:, None]
    times = np.array([look.time for look in problem.looks])
    return refined_viewmats(given, times, state.scene.twists, problem.looks, problem.radius)[:, 0]


@pytest.mark.slow
def test_finds_where_cameras_stood(looks, askew):
    """By the scene alone: nothing moves, and all looks teach it."""
    config = replace(CONFIG, warmup=120, iterations=0, warmup_frames="all")
    problem, state = begin_deform(askew, config)
    for found in reconstruct(problem, state):
        state = found.state
        assert not found.info["skipped"]
    before = corners_off([look.viewmat for look in askew], looks)
    after = corners_off(found_viewmats(problem, state), looks)
    assert before[1:].mean() > 0.4
    assert after.mean() < 0.5 * before.mean()


class TestRefining:
    def test_leaves_the_first_look_where_it_is_and_moves_others(self, learned, askew):
        problem, state = learned
        np.testing.assert_array_equal(state.scene.twists[problem.first], 0)
        assert (np.abs(np.asarray(state.scene.twists[1:])).max(axis=1) > 1e-4).all()
        np.testing.assert_allclose(found_viewmats(problem, state)[0], askew[0].viewmat, atol=1e-6)

    def test_costs_nothing_where_it_is_off(self, askew):
        _, state = begin_deform(askew, replace(CONFIG, refine_poses=False))
        assert state.scene.twists is None

    def test_goes_on_to_the_same_bits(self, learned, askew, tmp_path):
        problem, whole = learned
        _, state = begin_deform(askew, CONFIG)
        for found in reconstruct(problem, state):
            if found.state.step == 6:
                save_checkpoint(tmp_path / "state.npz", jax.device_get(found.state))
                break
        _, first = begin_deform(askew, CONFIG)
        state, _ = load_checkpoint(tmp_path / "state.npz", of_step(problem, first, 6))
        for found in reconstruct(problem, state):
            state = found.state
        for one, other in zip(jax.tree.leaves(whole.scene), jax.tree.leaves(state.scene), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_slopes_are_of_the_looks_own_twist(self, learned):
        problem, state = learned
        loss, rows = deform_loss(CONFIG, problem.radius), state.scene.twists
        plan, key = problem.plan_for(state), jax.random.key(0)

        @jax.jit
        def of(twists, batch):
            return loss(DeformingScene(state.scene.gaussians, None, twists), batch, step=0, key=key)[0]

        slopes = [np.asarray(jax.grad(of)(rows, batch._replace(plan=plan))) for batch in problem.batches]
        for i, slope in enumerate(slopes):
            others = np.arange(len(rows)) != i
            np.testing.assert_array_equal(slope[others], 0)
            assert slope[i].any() == (i != problem.first)
        # Down the slope it is less.
        step = 1e-4 * slopes[2] / np.linalg.norm(slopes[2])
        batch = problem.batches[2]._replace(plan=plan)
        fall = float(of(rows - step, batch) - of(rows + step, batch))
        np.testing.assert_allclose(fall, -2e-4 * np.linalg.norm(slopes[2]), rtol=0.15)


class TestBetweenLooks:
    @pytest.fixture
    def twists(self, askew):
        random = np.random.default_rng(2)
        return jnp.asarray(random.normal(size=(len(askew), 6)) * 0.01, jnp.float32)

    def test_what_is_off_lies_between_that_of_neighbours(self, askew, twists):
        view = np.eye(4)[None, None]
        middle = 0.5 * (askew[1].time + askew[2].time)
        found = refined_viewmats(view, np.array([middle]), twists, askew, 2.0)[0, 0]
        shift = 2.0 * np.asarray(twists[1, 3:] + twists[2, 3:]) / 2
        np.testing.assert_allclose(center(found), shift, atol=1e-6)
        beyond = refined_viewmats(view, np.array([1.5]), twists, askew, 2.0)[0, 0]
        np.testing.assert_allclose(center(beyond), 2.0 * np.asarray(twists[-1, 3:]), atol=1e-6)

    def test_looks_in_any_order(self, askew, twists):
        view, times = np.repeat(np.eye(4)[None, None], 2, axis=0), np.array([0.1, 0.6])
        order = np.array([3, 0, 2, 1])
        one = refined_viewmats(view, times, twists, askew, 1.0)
        other = refined_viewmats(view, times, twists[order], [askew[i] for i in order], 1.0)
        np.testing.assert_allclose(one, other, atol=1e-7)

    def test_the_other_eye_moves_along(self, askew, twists):
        left = askew[2].viewmat
        beside = np.eye(4)
        beside[:3, :3], beside[0, 3] = Rotation.from_rotvec([0, 0.05, 0]).as_matrix(), -0.0045
        pair = np.stack([left, beside @ left])[None]
        found = refined_viewmats(pair, np.array([askew[2].time]), twists, askew, 0.05)[0]
        np.testing.assert_allclose(found[1] @ np.linalg.inv(found[0]), beside, atol=1e-9)
        assert turned(found[0], left) > 0.1
