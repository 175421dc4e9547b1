"""DIS flow of images that were shifted by a known amount."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter, shift

from gsjax.geometry.flow import seen_in_both
from gsjax.methods.protocols import OpticalFlow
from gsjax.perception.optical_flow import DisFlow


@pytest.fixture(scope="module")
def textured():
    noise = gaussian_filter(np.random.default_rng(0).uniform(size=(72, 96, 3)), (1.5, 1.5, 0))
    return (noise - noise.min()) / np.ptp(noise)


@given(st.floats(-5, 5), st.floats(-4, 4))
def test_a_shift_is_found(textured, x, y):
    """The flow points to where the content moved, x before y."""
    moved = shift(textured, (y, x, 0), order=3, mode="nearest")
    errors = np.linalg.norm(DisFlow()(textured, np.clip(moved, 0, 1)) - [x, y], axis=-1)[12:-12, 12:-12]
    assert np.median(errors) < 0.1
    assert np.mean(errors < 0.5) > 0.95


def test_what_is_hidden_fails_the_way_back(textured):
    """A square moves 6 pixels to the right over a static background."""
    square = textured[::-1, ::-1][20:50, 30:60]
    before, after = textured.copy(), textured.copy()
    before[20:50, 30:60], after[20:50, 36:66] = square, square
    flow = DisFlow()
    forward, backward = flow(before, after), flow(after, before)
    seen = seen_in_both(forward, backward)
    assert np.median(np.linalg.norm(forward[24:46, 36:54] - [6, 0], axis=-1)) < 0.3
    hidden = np.zeros(seen.shape, bool)
    hidden[21:49, 61:65] = True
    assert seen[hidden].mean() < 0.3
    assert seen[~hidden].mean() > 0.7


def test_nothing_moves_in_equal_pictures_and_bytes_are_as_good_as_floats(textured):
    flow = DisFlow("fast")
    assert isinstance(flow, OpticalFlow)
    assert np.abs(flow(textured, textured)).max() < 1e-3
    as_bytes = np.round(255 * textured).astype(np.uint8)
    moved = np.roll(as_bytes, 3, axis=1)
    np.testing.assert_array_equal(flow(as_bytes, moved), flow(as_bytes / 255.0, moved / 255.0))
    assert flow(as_bytes, moved).shape == (72, 96, 2)


def test_pictures_that_do_not_fit_are_named(textured):
    with pytest.raises(
        ValueError, match=r"other: expected shape \(72, 96, 3\) to match image, found \(71, 96, 3\)"
    ):
        DisFlow()(textured, textured[1:])
    with pytest.raises(ValueError, match=r"image: expected shape \[H, W, 3\], RGB, found \(72, 96\)"):
        DisFlow()(textured[..., 0], textured[..., 0])
    for rows, columns in ((11, 11), (7, 40), (40, 7)):
        with pytest.raises(ValueError, match=r"image: expected at least 8 by 12 pixels"):
            DisFlow()(textured[:rows, :columns], textured[:rows, :columns])
    assert DisFlow()(textured[:8, :12], textured[:8, :12]).shape == (8, 12, 2)
