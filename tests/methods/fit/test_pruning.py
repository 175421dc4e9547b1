"""The light that a Gaussian sends into photographs is its compositing weights; without it, it is pruned."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.fit import light_of, needed
from gsjax.rasterize.reference import rasterization_reference
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import gaussians_from_activated

WIDTH, HEIGHT = 32, 24


def view(eye) -> Frame:
    viewmat, K = look_at(np.array(eye), np.zeros(3)), intrinsics(30.0, WIDTH, HEIGHT)
    camera = Camera(viewmat[None], K[None], WIDTH, HEIGHT)
    return Frame(np.zeros((1, HEIGHT, WIDTH, 3), np.uint8), None, camera)


def wall(count=60):
    """An opaque wall at x = 0, one Gaussian behind it, and one that no camera faces."""
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-1, 1, 12)), -1).reshape(-1, 2)
    means = np.concatenate([np.c_[np.zeros(len(grid)), grid], [[-0.5, 0, 0], [9.0, 0, 0]]])
    n = len(means)
    scales = np.full((n, 3), 0.12)
    return gaussians_from_activated(
        means, random.normal(size=(n, 4)), scales, np.full(n, 0.99), random.uniform(size=(n, 3))
    )


@pytest.mark.thorough
def test_light_is_the_sum_of_weights_in_the_view_that_sees_the_most():
    gaussians, views = wall(), [view((3.0, 0.2, 0.5)), view((2.5, -0.8, 0.1))]
    light = light_of(gaussians, views)
    summed = []
    for one in views:  # each Gaussian's colour is its own unit vector, so the image holds all weights
        drawn = rasterization_reference(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            jnp.eye(gaussians.num),
            jnp.asarray(one.cameras.viewmat[0]),
            jnp.asarray(one.cameras.K[0]),
            WIDTH,
            HEIGHT,
        )[0]
        summed.append(np.asarray(drawn).sum((0, 1)))
    np.testing.assert_allclose(
        light, np.max([one / one.sum() for one in summed], axis=0), rtol=1e-3, atol=1e-6
    )


@pytest.mark.thorough
def test_what_is_hidden_or_behind_all_cameras_sends_none():
    light = light_of(wall(), [view((3.0, 0.2, 0.5))])
    assert light[-1] == 0.0
    assert light[-2] < 1e-4
    assert np.median(light[:-2]) > 1e-3


@given(st.lists(st.floats(0, 0.01), max_size=30), st.floats(0, 0.05))
def test_what_is_left_out_is_needed_least_and_sends_no_more_than_the_share(light, share):
    light = np.array(light)
    kept = needed(light, share)
    assert light[~kept].sum() <= share + 1e-12
    if kept.any():
        assert light[~kept].max(initial=0.0) <= light[kept].min()
        assert light[~kept].sum() + light[kept].min() > share - 1e-12  # one more would exceed the share


def test_a_scene_that_is_small_in_its_pictures_is_needed_all_the_same():
    light = light_of(wall(), [view((60.0, 0.0, 0.0))])
    assert needed(light, 0.002).sum() > 100
