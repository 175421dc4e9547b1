"""Poses refined together with a deforming scene."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gsjax
from gsjax.engine.drive import drive
from gsjax.methods.deform import (
    Deform,
    DeformConfig,
    DeformingScene,
    DeformRatesConfig,
    Kept,
    batch_of,
    deform_loss,
    refined_viewmats,
    times_of,
)
from gsjax.scene.deformation import DeformationConfig
from tests.methods.deform.tissue import frames_of

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
    """The view matrix of a camera rotated about its centre (degrees) and translated (metres)."""
    rotation = viewmat[:3, :3] @ Rotation.from_rotvec(np.deg2rad(twist[:3])).as_matrix().T
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = rotation, -rotation @ (center(viewmat) + twist[3:])
    return found


def center(viewmat):
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def turned(one, other):
    """The angle between the orientations of two cameras, degrees."""
    return np.rad2deg(Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).magnitude())


@pytest.fixture(scope="module")
def frames():
    """Frames of static built-in tissue, with tools masked."""
    seen = gsjax.open_sequence("simulated:tissue?width=40&height=32&frames=4&still=true").select(cameras=(0,))
    return frames_of(seen)


@pytest.fixture(scope="module")
def askew(frames):
    """The same, with pose errors of 1 degree and 1.5 mm in all frames but the first."""
    random = np.random.default_rng(0)
    twists = random.normal(size=(len(frames), 6)) * np.repeat([0.6, 0.9e-3], 3)
    twists[0] = 0
    return [
        eqx.tree_at(lambda f: f.cameras.viewmat, frame, off_by(frame.cameras.viewmat[0], twist)[None])
        for frame, twist in zip(frames, twists, strict=True)
    ]


def viewmats_of(frames):
    return np.concatenate([frame.cameras.viewmat for frame in frames])


def corners_off(found, frames):
    """Mean reprojection error of each frame, pixels, as rotations and translations are hardly separable."""
    offs = []
    for viewmat, frame in zip(found, frames, strict=True):
        pixels = np.array([[5, 5, 1], [35, 5, 1], [20, 16, 1], [5, 27, 1], [35, 27, 1]], float)
        true, K = frame.cameras.viewmat[0], frame.cameras.K[0]
        points = np.median(frame.depths) * pixels @ np.linalg.inv(K).T
        world = (points - true[:3, 3]) @ true[:3, :3]
        there = (world @ viewmat[:3, :3].T + viewmat[:3, 3]) @ K.T
        offs.append(np.linalg.norm(there[:, :2] / there[:, 2:] - pixels[:, :2], axis=1).mean())
    return np.array(offs)


@pytest.fixture(scope="module")
def learned(askew):
    *_, last = drive(Deform(CONFIG), *Deform(CONFIG).start(askew))
    return last


@pytest.mark.slow
def test_recovers_the_true_poses(frames, askew):
    """In a static scene, from all frames."""
    method = Deform(replace(CONFIG, warmup=120, iterations=0, warmup_frames="all"))
    for now in drive(method, *method.start(askew)):
        assert not now.info["skipped"]
    before = corners_off(viewmats_of(askew), frames)
    after = corners_off(now.result.timeline.viewmats, frames)
    assert before[1:].mean() > 0.4
    assert after.mean() < 0.5 * before.mean()


class TestRefining:
    @pytest.mark.slow
    def test_leaves_the_first_frame_where_it_is_and_moves_others(self, learned, askew):
        twists = learned.run.params.twists
        np.testing.assert_array_equal(twists[learned.problem.first], 0)
        assert (np.abs(np.asarray(twists[1:])).max(axis=1) > 1e-4).all()
        found, given = learned.result.timeline.viewmats, viewmats_of(askew)
        np.testing.assert_allclose(found[0], given[0], atol=1e-6)
        assert (np.abs(found - given)[1:].max(axis=(1, 2)) > 1e-6).all()

    def test_costs_nothing_where_it_is_off(self, askew):
        _, run = Deform(replace(CONFIG, refine_poses=False)).start(askew)
        assert run.params.twists is None

    def test_frames_without_a_time_share_one(self, askew):
        for count in (2, len(askew)):
            timeless = [replace(frame, time=None) for frame in askew[:count]]
            with pytest.raises(ValueError, match="refine_poses: expected frames at different times"):
                Deform(CONFIG).start([*timeless, *askew[count:]])

    @pytest.mark.slow
    def test_gradients_are_of_the_frames_own_twist(self, learned):
        problem, run = learned.problem, learned.run
        loss, rows, key = deform_loss(CONFIG), run.params.twists, jax.random.key(0)
        still = run.having(kept=Kept())

        @jax.jit
        def of(twists, batch):
            return loss(DeformingScene(run.params.gaussians, None, twists), batch, step=0, key=key)[0]

        batches = [batch_of(problem, still, i) for i in range(len(problem.frames))]
        slopes = [np.asarray(jax.grad(of)(rows, batch)) for batch in batches]
        for i, slope in enumerate(slopes):
            others = np.arange(len(rows)) != i
            np.testing.assert_array_equal(slope[others], 0)
            assert slope[i].any() == (i != problem.first)
        # A step against the gradient lowers the loss.
        step = 1e-4 * slopes[2] / np.linalg.norm(slopes[2])
        fall = float(of(rows - step, batches[2]) - of(rows + step, batches[2]))
        np.testing.assert_allclose(fall, -2e-4 * np.linalg.norm(slopes[2]), rtol=0.15)


class TestBetweenFrames:
    @pytest.fixture
    def twists(self, askew):
        random = np.random.default_rng(2)
        return jnp.asarray(random.normal(size=(len(askew), 6)) * 0.01, jnp.float32)

    def test_corrections_are_interpolated_between_neighbours(self, askew, twists):
        view, learned = np.eye(4)[None, None], times_of(askew)
        middle = 0.5 * (learned[1] + learned[2])
        found = refined_viewmats(view, np.array([middle]), twists, learned, 2.0)[0, 0]
        shift = 2.0 * np.asarray(twists[1, 3:] + twists[2, 3:]) / 2
        np.testing.assert_allclose(center(found), shift, atol=1e-6)
        beyond = refined_viewmats(view, np.array([1.5]), twists, learned, 2.0)[0, 0]
        np.testing.assert_allclose(center(beyond), 2.0 * np.asarray(twists[-1, 3:]), atol=1e-6)

    def test_frames_in_any_order(self, askew, twists):
        view, times = np.repeat(np.eye(4)[None, None], 2, axis=0), np.array([0.1, 0.6])
        order, learned = np.array([3, 0, 2, 1]), times_of(askew)
        one = refined_viewmats(view, times, twists, learned, 1.0)
        other = refined_viewmats(view, times, twists[order], learned[order], 1.0)
        np.testing.assert_allclose(one, other, atol=1e-7)

    def test_the_other_eye_moves_along(self, askew, twists):
        left, learned = askew[2].cameras.viewmat[0], times_of(askew)
        beside = np.eye(4)
        beside[:3, :3], beside[0, 3] = Rotation.from_rotvec([0, 0.05, 0]).as_matrix(), -0.0045
        pair = np.stack([left, beside @ left])[None]
        found = refined_viewmats(pair, learned[2:3], twists, learned, 0.05)[0]
        np.testing.assert_allclose(found[1] @ np.linalg.inv(found[0]), beside, atol=1e-9)
        assert turned(found[0], left) > 0.1
