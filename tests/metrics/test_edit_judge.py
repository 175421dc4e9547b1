"""The scripted judge on a request to move a square to the right: done, not done, half done, badly done."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from gsjax.geometry.cameras import intrinsics
from gsjax.metrics.edit_judge import (
    place_is_clean,
    requested_displacement,
    requested_motion_is_seen,
    rest_stays,
)

seeds = st.integers(0, 10_000)
FRAMES, HEIGHT, WIDTH, SIDE = 2, 24, 40, 8


def scene(seed, x):
    """A textured square whose left side is at `x`, in front of a pattern; its mask; and the pattern alone."""
    rng = np.random.default_rng(seed)
    behind = 0.5 * gaussian_filter(rng.uniform(size=(HEIGHT, WIDTH, 3)), (1, 1, 0))
    part = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    part[:, 8 : 8 + SIDE, x : x + SIDE] = True
    video = np.tile(behind, (FRAMES, 1, 1, 1))
    video[part] = np.tile(rng.uniform(0.5, 1, (SIDE * SIDE, 3)), (FRAMES, 1))
    return video, part, np.tile(behind, (FRAMES, 1, 1, 1))


def requested_shift(part, pixels):
    displacement = np.full((*part.shape, 2), np.nan)
    displacement[part] = [pixels, 0.0]
    return displacement


@given(seeds, st.integers(1, 20))
def test_what_was_asked_and_done_is_perfect(seed, pixels):
    before, part, behind = scene(seed, 6)
    after, there, _ = scene(seed, 6 + pixels)
    assert rest_stays(before, after, part | there).score == 1
    assert requested_motion_is_seen(before, after, requested_shift(part, pixels)).score == 1
    assert place_is_clean(after, np.ones(part.shape), behind, part & ~there).score == 1


@given(seeds, st.integers(1, 20))
def test_what_was_asked_and_not_done_is_nothing(seed, pixels):
    before, part, _ = scene(seed, 6)
    assert requested_motion_is_seen(before, before, requested_shift(part, pixels)).score == 0
    deleted = np.where(part[..., None], 0.0, before)
    assert requested_motion_is_seen(before, deleted, requested_shift(part, pixels)).score < 0.2


def test_another_way_than_asked_is_not_found():
    before, part, _ = scene(0, 6)
    after, _, _ = scene(0, 9)
    wrong = requested_motion_is_seen(before, after, requested_shift(part, 12))
    assert wrong.score < 0.2
    assert "12.0 pixels away" in wrong.reason


def test_pixels_that_would_look_the_same_do_not_count():
    """The inside of a uniform square is not informative; its leading edge is."""
    before, after = np.zeros((2, 1, 16, 32, 3))
    before[:, 4:12, 4:12], after[:, 4:12, 7:15] = 1.0, 1.0
    part = before[..., 0] > 0
    assert requested_motion_is_seen(before, after, requested_shift(part, 3)).reason.startswith("24 of 24 ")
    assert requested_motion_is_seen(before, before, requested_shift(part, 3)).reason.startswith("0 of 24 ")
    unasked = requested_motion_is_seen(before, after, requested_shift(part, 0))
    assert math.isnan(unasked.score)
    assert unasked.reason.startswith("no pixel to judge whether")


@given(seeds, st.integers(0, 200))
def test_the_rest_is_counted_pixel_by_pixel(seed, changed):
    rng = np.random.default_rng(seed)
    before, part, _ = scene(seed, 6)
    after = before.copy()
    outside = np.flatnonzero(~part)
    spoilt = np.unravel_index(rng.permutation(outside)[:changed], part.shape)
    after[*spoilt, rng.integers(3)] += 0.01  # of one channel
    found = rest_stays(before, after, part)
    assert found.score == pytest.approx(1 - changed / len(outside))
    assert rest_stays(before, after, part, tolerance=0.01).score == 1
    assert f"{len(outside) - changed:,} of {len(outside):,}" in found.reason


def test_one_step_of_a_byte_is_allowed():
    before = np.full((1, 4, 5, 3), 100, np.uint8)
    nowhere = np.zeros((1, 4, 5), bool)
    assert rest_stays(before, before + np.uint8(1), nowhere).score == 1
    assert rest_stays(before, before + np.uint8(2), nowhere).score == 0
    assert rest_stays(before, before / 255.0, nowhere).score == 1
    assert math.isnan(rest_stays(before, before, ~nowhere).score)


def test_holes_and_ghosts_are_told_apart():
    before, part, behind = scene(0, 6)
    after, there, _ = scene(0, 20)
    alphas = np.ones(part.shape)
    alphas[0, 8, 6:9] = 0.2
    after[0, 8, 6] = after[1, 8:10, 6] = 1.0  # one of them in a hole
    found = place_is_clean(after, alphas, behind, part & ~there)
    assert found.score == pytest.approx(1 - 5 / 128)
    assert found.reason == "123 of 128 vacated pixels show what is behind (3 holes, 2 ghosts)"
    left_behind = place_is_clean(before, np.ones(part.shape), behind, part)
    assert left_behind.score < 0.05
    assert math.isnan(place_is_clean(after, alphas, behind, 0 * part == 1).score)


def test_a_displacement_follows_from_depth_and_motion():
    """10 cm to the right at 2 m and a focal length of 100 are 5 pixels; nearer points move farther."""
    depth, after, part = np.full((6, 24), 2.0), np.full((6, 24), 3.0), np.ones((6, 24), bool)
    depth[0], depth[1, 1], part[2, 2] = 1.0, 0.0, False
    after[3, 10], after[3, 12], after[3, 14] = 1.9, 1.99, 0.0  # in the way; within the tolerance; unknown
    motion, viewmat = np.eye(4), np.eye(4)
    motion[0, 3], viewmat[:3, 3] = 0.1, [0.3, -0.2, 0.0]
    camera = (viewmat, intrinsics(100.0, 24, 6))
    asked = requested_displacement(depth, after, part, motion, *camera)
    expected = np.zeros((6, 24, 2))
    expected[0, :, 0], expected[1:, :, 0] = 10.0, 5.0
    expected[0, 14:] = expected[1:, 19:] = np.nan  # out of the picture
    expected[1, 1] = expected[2, 2] = expected[3, 5] = np.nan
    np.testing.assert_allclose(asked, expected, atol=1e-3)
    back = np.eye(4)
    back[2, 3] = -2.5
    assert np.isnan(requested_displacement(depth, after, part, back, *camera)).all()


def test_shapes_that_do_not_fit_are_named():
    before, part, behind = scene(0, 6)
    with pytest.raises(ValueError, match=r"touched: expected shape \(2, 24, 40\), found \(1, 24, 40\)"):
        rest_stays(before, before, part[1:])
    with pytest.raises(ValueError, match=r"after: expected shape \(2, 24, 40, 3\), found \(1, 24, 40, 3\)"):
        requested_motion_is_seen(before, before[1:], requested_shift(part, 1))
    with pytest.raises(ValueError, match=r"alphas: expected shape \(2, 24, 40\), found \(2, 23, 40\)"):
        place_is_clean(before, np.ones((2, 23, 40)), behind, part)
