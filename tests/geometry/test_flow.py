"""Warping along a flow, and where a flow is reliable."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.geometry.flow import seen_in_both, warp

seeds = st.integers(0, 10_000)


def constant(shape, x, y):
    return np.broadcast_to(np.array([x, y], float), (*shape, 2)).copy()


@given(seeds, st.integers(-4, 4), st.integers(-4, 4))
def test_whole_pixels_are_moved_without_loss(seed, x, y):
    picture = np.random.default_rng(seed).uniform(size=(9, 12, 3))
    warped = warp(picture, constant((9, 12), x, y))
    rows, columns = np.indices((9, 12)) + np.array([y, x])[:, None, None]
    inside = (rows >= 0) & (rows < 9) & (columns >= 0) & (columns < 12)
    np.testing.assert_array_equal(np.isfinite(warped).all(-1), inside)
    np.testing.assert_array_equal(warped[inside], picture[rows[inside], columns[inside]])


@given(seeds)
def test_between_pixels_a_slope_is_read_exactly(seed):
    """Bilinear interpolation is exact for a linear image, whatever the flow."""
    rng = np.random.default_rng(seed)
    rows, columns = np.indices((8, 10))
    flow = rng.uniform(-3, 3, (8, 10, 2))
    warped = warp(2.0 * columns - 3.0 * rows, flow)
    expected = 2.0 * (columns + flow[..., 0]) - 3.0 * (rows + flow[..., 1])
    inside = np.isfinite(warped)
    assert inside.any()
    np.testing.assert_allclose(warped[inside], expected[inside], atol=1e-9)
    ends = np.stack([columns + flow[..., 0], rows + flow[..., 1]], axis=-1)
    np.testing.assert_array_equal(inside, ((ends >= 0) & (ends <= [9, 7])).all(-1))


def test_what_is_unknown_stays_unknown():
    flow = constant((8, 8), 0.5, 0.25)
    flow[2, 3] = np.nan
    picture = np.ones((8, 8))
    picture[5, 4] = np.nan
    known = np.isfinite(warp(picture, flow))
    expected = np.ones((8, 8), bool)
    expected[2, 3] = expected[:, 7] = expected[7, :] = False
    expected[4:6, 3:5] = False  # these end next to the unknown pixel
    np.testing.assert_array_equal(known, expected)


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_there_and_back_again_is_seen_in_both(x, y):
    seen = seen_in_both(constant((10, 12), x, y), constant((10, 12), -x, -y))
    rows, columns = np.indices((10, 12))
    inside = (columns + x >= 0) & (columns + x <= 11) & (rows + y >= 0) & (rows + y <= 9)
    np.testing.assert_array_equal(seen, inside)


@pytest.mark.parametrize(("off", "believed"), [(0.70, True), (0.71, False)])
def test_the_way_back_of_what_stands_still_may_miss_by_the_root_of_a_half(off, believed):
    """|f + b|^2 <= 0.01 |b|^2 + 0.5 switches at |b| = 0.7107 pixels for f = 0."""
    forward, backward = constant((8, 8), 0, 0), constant((8, 8), off + 0.005, 0)
    assert seen_in_both(forward, backward)[4, 4] == believed


def test_far_motion_may_miss_by_more():
    forward = constant((8, 40), 10, 0)
    for off, believed in ((1.4, True), (1.6, False)):  # off^2 = 0.01 (100 + (10 - off)^2) + 0.5 at 1.49
        assert seen_in_both(forward, constant((8, 40), off - 10, 0))[4, 4] == believed


def test_the_edge_of_what_moves_is_left_out():
    forward = constant((8, 12), 0, 0)
    forward[:, 6:] = [1.0, 0.0]
    seen = seen_in_both(forward, np.zeros_like(forward))
    assert not seen[:, 5].any()
    assert seen[:, :5].all()
    assert not seen[:, 6:].any()  # the way back misses by a pixel


def test_unknown_flow_is_not_believed():
    forward = constant((6, 6), 0, 0)
    forward[3, 3] = np.nan
    seen = seen_in_both(forward, constant((6, 6), 0, 0))
    assert not seen[3, 3]
    assert seen[0, 0]
    assert not seen_in_both(constant((6, 6), 0, 0), forward)[3, 3]
