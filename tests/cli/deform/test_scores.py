"""Scores of a deforming scene's frames over time, and the classes of their pixels."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.deform.scores import OVER_TIME, Drawn, _of_frame, classes_of_pixels, over_time
from tests.methods.deform.tissue import one_frame

HEIGHT, WIDTH = 40, 48


def picture(shift=0.0):
    rows, columns = np.indices((HEIGHT, WIDTH))
    waves = np.sin((columns - shift) / 3) * np.cos(rows / 4)
    return np.stack(
        [0.5 + 0.4 * waves, 0.5 - 0.3 * waves, 0.5 + 0.2 * np.cos((columns - shift) / 5)], axis=-1
    )


def seen(shift, mask=None):
    image = np.round(255 * picture(shift)).astype(np.uint8)
    return one_frame(image, np.eye(4), np.eye(3), 0.0, mask=mask)


def test_the_recording_is_as_steady_as_itself():
    frames = [seen(0.0), seen(1.0)]
    row = over_time([(one.images[0] / 255.0, one) for one in frames])
    for name in OVER_TIME:
        assert row[name] == row[f"{name}_true"]
    assert row["t_ssim"] < 0.97
    assert row["warped_ssim"] > row["t_ssim"]
    assert row["flow_warp_share"] > 0.8


def test_a_frozen_scene_is_steadier_than_the_recording():
    row = over_time([(picture(0.5), seen(0.0)), (picture(0.5), seen(1.0))])
    assert row["t_ssim"] == pytest.approx(1)
    assert row["flow_warp_error"] == pytest.approx(0, abs=1e-6)
    assert row["t_ssim_true"] < 0.97


def test_what_does_not_count_changes_nothing():
    counts = np.ones((HEIGHT, WIDTH), bool)
    counts[10:20, 10:24] = False
    frames = [seen(0.0, counts), seen(1.0, counts)]
    odd = [np.where(counts[..., None], picture(i + 0.3), i) for i in (0, 1)]
    plain = [np.where(counts[..., None], picture(i + 0.3), 0.5) for i in (0, 1)]
    assert over_time(list(zip(odd, frames, strict=True))) == over_time(list(zip(plain, frames, strict=True)))


def test_too_small_pictures_have_none():
    small = one_frame(np.zeros((11, 11, 3), np.uint8), np.eye(4), np.eye(3), 0.0)
    assert over_time([(np.zeros((11, 11, 3)), small)] * 2) == {}


def test_a_neighbour_without_a_mask_is_not_compared():
    counts = np.ones((HEIGHT, WIDTH), bool)
    assert over_time([(picture(), seen(0.0, counts)), (picture(1.0), seen(1.0))]) == {}


def test_what_does_not_count_does_not_change_the_similarity_around_it():
    """Regression test: windows at the outline of a tool compared it with the tissue drawn behind it."""
    counts = np.ones((HEIGHT, WIDTH), bool)
    counts[10:20, 10:20] = False
    frame = seen(0.0, counts)
    colors = np.where(counts[..., None], frame.images[0] / 255.0, 1.0)
    assert _of_frame(Drawn(colors, np.ones((HEIGHT, WIDTH)), None), frame)["ssim"] == pytest.approx(1)


def test_pixels_are_of_the_class_whose_code_is_nearest():
    codes = jnp.eye(3, 5)
    features = jnp.array([[[0.1, 0.02, 0, 0, 0], [0, 0, 7.0, 0, 1], [0, 0, 0, 0, 0]]])  # the last has none
    np.testing.assert_array_equal(classes_of_pixels(features, codes), [[0, 2, -1]])


def test_a_single_class_is_all_that_is_drawn():
    features = jnp.array([[[0.1, 0.02], [0, 0]]])
    np.testing.assert_array_equal(classes_of_pixels(features, jnp.eye(1, 2)), [[0, -1]])
