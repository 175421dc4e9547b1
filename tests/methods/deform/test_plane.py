"""Initialization of a deforming scene without depth."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.methods.deform import Deform, DeformConfig
from gsjax.methods.deform.start import with_plane_depths
from gsjax.scene.initialize import points_from_rgbd
from tests.methods.deform.tissue import one_frame

K = intrinsics(50.0, 40, 32)
UP = np.array([0.0, 1.0, 0.0])
TINY = DeformConfig(warmup=3, iterations=3, nodes=16)


@pytest.fixture(scope="module")
def frames():
    """Frames of a camera that moves around an object at an unknown distance."""
    images = np.random.default_rng(0).integers(0, 255, (3, 32, 40, 3), np.uint8)
    eyes = np.array([[0.1, 0.2, -2.0], [0.6, 0.1, -1.8], [-0.7, 0.3, -2.2]])
    views = [look_at(eye, np.array([0.05, 0.0, 0.0]), UP) for eye in eyes]
    return [
        one_frame(image, view, K, t / 2) for t, (image, view) in enumerate(zip(images, views, strict=True))
    ]


def test_all_frames_see_one_plane_that_the_first_faces(frames):
    seen, facing = with_plane_depths(frames, 1, 1.5), frames[1].cameras.viewmat[0]
    np.testing.assert_allclose(seen[1].depths, 1.5, rtol=1e-6)
    for frame in seen:
        viewmat, K = frame.cameras.viewmat[0], frame.cameras.K[0]
        points, _ = points_from_rgbd(frame.images[0], frame.depths[0], viewmat, K)
        before_first = points @ facing[2, :3] + facing[2, 3]
        np.testing.assert_allclose(before_first, 1.5, rtol=1e-5)


def test_a_camera_that_looks_away_sees_none_of_it(frames):
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ frames[0].cameras.viewmat
    away = eqx.tree_at(lambda f: f.cameras.viewmat, frames[0], turned)
    np.testing.assert_array_equal(with_plane_depths([frames[0], away], 0, 1.0)[1].depths, 0)


@pytest.mark.thorough
def test_a_scene_starts_there_from_the_first_frame_with_pixels_that_count(frames):
    hidden = np.zeros((1, 32, 40), bool)
    part = np.ones((1, 32, 40), bool)
    part[..., :20] = False
    masked = [replace(frames[0], masks=hidden), replace(frames[0], masks=part), frames[0]]
    problem, run = Deform(replace(TINY, plane_depth=0.5)).start(masked)
    assert problem.first == 1
    assert not problem.timeline.metric
    means, viewmat = np.asarray(run.params.gaussians.means), frames[0].cameras.viewmat[0]
    local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    np.testing.assert_allclose(local[:, 2], 0.5, rtol=1e-5)
    x = (local @ K.T)[:, 0] / local[:, 2]
    assert (x < 20).any()  # the last frame shows what the one before does not
    assert (problem.bounds[1] - problem.bounds[0]).min() > 0.01 * problem.radius


def test_a_plane_nearer_than_the_near_plane_is_named(frames):
    with pytest.warns(UserWarning, match=r"nearer to the cameras than their near plane, .* \(--read.near\)"):
        Deform(replace(TINY, plane_depth=0.005)).start(frames[:1])


@pytest.mark.slow
def test_no_depth_has_no_loss_and_learns(frames):
    method = Deform(TINY)
    infos = [jax.device_get(now.info) for now in drive(method, *method.start(frames[:1] * 2))]
    assert not any("depth" in info or info["skipped"] for info in infos)
    assert infos[-1]["loss"] < infos[0]["loss"]
