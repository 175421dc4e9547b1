"""Frames of 8-bit images give the same results as frames of floats."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import Camera
from gsjax.scene.frame import Frame, part_of, without_broken


def frame_of(images: np.ndarray) -> Frame:
    return Frame(images, None, Camera(np.eye(4)[None], np.eye(3)[None], images.shape[2], images.shape[1]))


@pytest.fixture
def images():
    return np.random.default_rng(0).integers(256, size=(1, 6, 8, 3)).astype(np.uint8)


@pytest.mark.parametrize("shrink", [1, 2])
def test_smaller_pictures_of_bytes_are_those_of_floats(images, shrink):
    whole = frame_of(images.astype(np.float32) / 255)
    found = part_of(frame_of(images), (), shrink).colors
    np.testing.assert_allclose(found, part_of(whole, (), shrink).colors, atol=1e-6)
    assert found.max() <= 1


def test_bytes_are_never_broken_and_floats_may_be(images):
    found, count = without_broken(frame_of(images))
    np.testing.assert_allclose(found.images, images / 255, atol=1e-6)
    assert count == 0
    poisoned = images.astype(np.float32) / 255
    poisoned[0, 2, 3, 1] = np.nan
    found, count = without_broken(frame_of(jnp.asarray(poisoned)))
    assert count == 1
    np.testing.assert_array_equal(found.images[0, 2, 3], 0)


@pytest.mark.parametrize("endless", [np.nan, np.inf, np.finfo(np.float32).max])
def test_where_depth_is_endless_it_is_unknown_and_the_colour_stays(images, endless):
    """Regression test: its square is infinite, so that the tracker stood still."""
    depths = np.full(images.shape[:3], 2.0, np.float32)
    depths[0, 2, 3] = endless
    found, count = without_broken(replace(frame_of(images), depths=depths))
    assert count == 1
    np.testing.assert_array_equal(found.depths, np.where(depths == 2, depths, 0))
    np.testing.assert_allclose(found.images, images / 255, atol=1e-6)
