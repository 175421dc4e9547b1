"""Where a deforming scene begins without depth."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.methods.deform import DeformConfig, Look, begin_deform, reconstruct
from gsjax.methods.deform.start import on_plane
from gsjax.scene.initialize import points_from_rgbd

K = intrinsics(50.0, 40, 32)
UP = np.array([0.0, 1.0, 0.0])
TINY = DeformConfig(warmup=3, iterations=3, nodes=16)


@pytest.fixture(scope="module")
def looks():
    """A camera that goes round something, and does not know how far that is."""
    images = np.random.default_rng(0).integers(0, 255, (3, 32, 40, 3), np.uint8)
    eyes = np.array([[0.1, 0.2, -2.0], [0.6, 0.1, -1.8], [-0.7, 0.3, -2.2]])
    views = [look_at(eye, np.array([0.05, 0.0, 0.0]), UP) for eye in eyes]
    return [
        Look(image, None, None, view, K, t / 2)
        for t, (image, view) in enumerate(zip(images, views, strict=True))
    ]


def test_all_looks_see_one_plane_that_the_first_faces(looks):
    seen = on_plane(looks, 1, 1.5)
    np.testing.assert_allclose(seen[1].depth, 1.5, rtol=1e-6)
    for look in seen:
        points, _ = points_from_rgbd(look.image, look.depth, look.viewmat, look.K)
        before_first = points @ looks[1].viewmat[2, :3] + looks[1].viewmat[2, 3]
        np.testing.assert_allclose(before_first, 1.5, rtol=1e-5)


def test_a_camera_that_looks_away_sees_none_of_it(looks):
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ looks[0].viewmat
    away = on_plane([looks[0], looks[0]._replace(viewmat=turned)], 0, 1.0)[1]
    np.testing.assert_array_equal(away.depth, 0)


def test_a_scene_begins_there_where_the_first_pixel_counts(looks):
    hidden = np.zeros((32, 40), bool)
    part = np.ones((32, 40), bool)
    part[:, :20] = False
    masked = [looks[0]._replace(counts=hidden), looks[0]._replace(counts=part), looks[0]]
    problem, state = begin_deform(masked, replace(TINY, plane_depth=0.5))
    assert problem.first == 1
    means = np.asarray(state.scene.gaussians.means)
    local = means @ looks[0].viewmat[:3, :3].T + looks[0].viewmat[:3, 3]
    np.testing.assert_allclose(local[:, 2], 0.5, rtol=1e-5)
    x = (local @ K.T)[:, 0] / local[:, 2]
    assert (x < 20).any()  # the last look shows what the one before does not
    assert (problem.bounds[1] - problem.bounds[0]).min() > 0.01 * problem.radius


def test_no_depth_has_no_loss_and_learns(looks):
    problem, state = begin_deform(looks[:1] * 2, TINY)
    infos = [jax.device_get(found.info) for found in reconstruct(problem, state)]
    assert not any("depth" in info or info["skipped"] for info in infos)
    assert infos[-1]["loss"] < infos[0]["loss"]
