"""Edits of time show parts as they were at other moments, to the bit if a moment is hit."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.joints import Joint
from gsjax.methods.parts import edits
from gsjax.methods.parts.trajectory import still
from tests.methods.parts.made_up_parts import (
    CENTERS,
    STEP,
    TIMES,
    assert_same,
    hinge,
    jointed,
    motions,
    rows,
    trajectory,
)

seeds = st.integers(0, 10_000)
ALL = range(4)


class TestAtTimes:
    @given(seeds)
    def test_moments_that_are_hit_are_kept_to_the_bit_and_ends_hold(self, seed):
        order = np.random.default_rng(seed).permutation(9)
        found = edits.at_times(trajectory(seed), jnp.asarray([*TIMES[order], -0.1, 7.0]))
        assert_same(rows(found, ALL, range(11)), rows(trajectory(seed), ALL, [*order, 0, 8]))

    @pytest.mark.usefixtures("x64")
    @given(seeds)
    def test_between_moments_a_hinge_turns_about_its_axis(self, seed):
        """Interpolated as a screw: halfway in time is halfway in angle, wherever the handle is."""
        rng = np.random.default_rng(seed)
        axis, point = Rotation.random(rng=rng).apply([0.0, 0.0, 1.0]), rng.normal(size=3)
        angles, centers = np.cumsum(rng.uniform(-1.5, 1.5, 9)), rng.normal(size=(1, 3))
        seen = jointed([Joint("revolute", axis, point, angles)], centers, TIMES)
        when = rng.uniform(0, 1, 20)
        expected = Joint("revolute", axis, point, np.interp(when, TIMES, angles)).motions()
        found = motions(edits.at_times(seen, jnp.asarray(when)), centers, 0)
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.usefixtures("x64")
    def test_between_moments_sizes_and_opacities_go_in_proportion_and_signs_mean_nothing(self):
        one = trajectory(0)
        flipped = eqx.tree_at(lambda t: t.poses.quats, one, one.poses.quats.at[::2].multiply(-3.0))
        when = jnp.asarray([0.03, 0.31, 0.9])
        found, other = edits.at_times(one, when), edits.at_times(flipped, when)
        assert_same(other.poses.translations, found.poses.translations, atol=1e-12)
        dots = jnp.abs(jnp.sum(other.poses.quats * found.poses.quats, axis=-1))
        np.testing.assert_allclose(dots, 1.0, atol=1e-12)
        for p in ALL:
            for name in ("opacities", "scales"):
                expected = np.interp(when, TIMES, getattr(one, name)[:, p])
                np.testing.assert_allclose(getattr(found, name)[:, p], expected, atol=1e-12)

    def test_one_moment_is_for_ever(self):
        found = edits.at_times(trajectory(0, moments=1), jnp.asarray([-1.0, 0.0, 3.0]))
        assert_same(rows(found, ALL, range(3)), rows(trajectory(0, moments=1), ALL, [0, 0, 0]))


def plays(edited, seed, indices, parts=(1,)):
    """Asserts that parts show these moments of `trajectory(seed)`, to the bit."""
    assert_same(rows(edited, parts, range(9)), rows(trajectory(seed), parts, indices))


class TestTime:
    @pytest.mark.parametrize(
        ("edit", "indices"),
        [
            (lambda t: edits.speed(t, [1], 2.0), [0, 2, 4, 6, 8, 8, 8, 8, 8]),
            (lambda t: edits.speed(t, [1], 2.0, 0.25, 0.75), [0, 1, 2, 4, 6, 7, 8, 8, 8]),
            (lambda t: edits.speed(t, [1], -1.0), [8, 7, 6, 5, 4, 3, 2, 1, 0]),
            (lambda t: edits.speed(t, [1], -2.0), [8, 6, 4, 2, 0, 0, 0, 0, 0]),
            (lambda t: edits.speed(t, [1], -2.0, 0.25, 0.75), [0, 1, 6, 4, 2, 7, 8, 8, 8]),
            (lambda t: edits.loop(t, [1], 0.25, 0.625), [0, 1, 2, 3, 4, 2, 3, 4, 2]),
            (lambda t: edits.loop(t, [1], 0.125, 0.375, times=2), [0, 1, 2, 1, 2, 3, 4, 5, 6]),
            (lambda t: edits.loop(t, [1], 0.25, 0.5, bounce=True), [0, 1, 2, 3, 4, 3, 2, 3, 4]),
            (lambda t: edits.loop(t, [1], 0.0, 0.25, 1, True), [0, 1, 2, 1, 0, 1, 2, 3, 4]),
            (lambda t: edits.loop(t, [1], 0.0, 0.25, 1, True, stay=True), [0, 1, 2, 1, 0, 0, 0, 0, 0]),
            (lambda t: edits.loop(t, [1], 0.125, 0.375, 2, stay=True), [0, 1, 2, 1, 2, 3, 3, 3, 3]),
            (lambda t: edits.speed(t, [1], 2.0, 0.25, 0.75, stay=True), [0, 1, 2, 4, 6, 6, 6, 6, 6]),
            (lambda t: edits.speed(t, [1], -1.0, 0.0, 0.375, stay=True), [3, 2, 1, 0, 0, 0, 0, 0, 0]),
            (lambda t: edits.freeze(t, [1], at=0.5), [0, 1, 2, 3, 4, 4, 4, 4, 4]),
            (lambda t: edits.freeze(t, [1]), [0] * 9),
            (lambda t: edits.freeze(t, [1], begin=0.25, end=0.625), [0, 1, 2, 2, 2, 2, 3, 4, 5]),
            (lambda t: edits.freeze(t, [1], at=0.75, begin=0.0), [6] * 9),
            (lambda t: edits.freeze(t, [1], 0.5, 0.25, 0.5), [0, 1, 4, 4, 4, 5, 6, 7, 8]),
            (lambda t: edits.freeze(t, [1], begin=5.0), range(9)),
            (lambda t: edits.speed(t, [1], 3.0, begin=5.0), range(9)),
        ],
    )
    def test_shows_these_moments(self, edit, indices):
        plays(edit(trajectory(8)), 8, indices)

    @given(seeds)
    def test_speed_1_and_one_loop_are_nothing_to_the_bit(self, seed):
        for edited in (
            edits.speed(trajectory(seed), ALL, 1.0, 0.2, 0.77),
            edits.loop(trajectory(seed), ALL, 0.2, 0.77, times=1),
        ):
            assert_same(edited, trajectory(seed))

    @given(seeds)
    def test_backwards_twice_is_nothing(self, seed):
        there = edits.speed(trajectory(seed), ALL, -1.0, 0.25, 0.75)
        back = edits.speed(there, ALL, -1.0, 0.25, 0.75)
        assert_same(rows(back, ALL, range(9)), rows(trajectory(seed), ALL, range(9)))

    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    @given(st.floats(0.2, 3.0), st.floats(0.2, 3.0))
    def test_speeds_multiply(self, a, b):
        """For a steady motion, which interpolation reproduces, in a film that is long enough for both."""
        long = edits.at_times(jointed([hinge(TIMES)], CENTERS[1:2], TIMES), STEP * jnp.arange(210.0))
        both = edits.speed(edits.speed(long, [0], a, 0.0, 1.0), [0], b, 0.0, 1 / a)
        once = edits.speed(long, [0], a * b, 0.0, 1.0)
        going = np.asarray(long.times) < 1 / (a * b) - STEP / b
        assert_same(both.poses.translations[going], once.poses.translations[going], atol=3e-4)
        # Where it stops between two moments, the corner is cut.
        assert_same(both.poses.translations, once.poses.translations, atol=0.5 * STEP)

    @given(seeds, st.sampled_from([1.0, 2.0, 4.0]))
    def test_fast_backwards_is_backwards_and_then_fast(self, seed, factor):
        there = edits.speed(trajectory(seed), [1], -1.0, 0.25, 0.75)
        assert_same(
            edits.speed(there, [1], factor, 0.25, 0.75),
            edits.speed(trajectory(seed), [1], -factor, 0.25, 0.75),
        )

    @given(seeds, st.integers(1, 4), st.integers(0, 3))
    def test_a_loop_has_its_period(self, seed, period, start):
        begin = start * STEP
        looped = edits.loop(trajectory(seed), [1], begin, begin + period * STEP)
        first = rows(looped, [1], range(start, 9 - period))
        assert_same(rows(looped, [1], range(start + period, 9)), first)

    @pytest.mark.thorough
    def test_rounding_of_times_does_not_show_the_wrong_side_of_a_seam(self):
        """Thirtieths of a second are inexact in binary; a loop of 7 frames shows 7 frames all the same."""
        times = jnp.arange(200.0) / 30
        shifts = jnp.arange(200.0)[:, None, None] * jnp.ones(3)
        counting = eqx.tree_at(lambda t: t.poses.translations, still(1, times), shifts)
        shown = edits.loop(counting, [0], 3 / 30, 10 / 30).poses.translations[:, 0, 0]
        expected = [0, 1, 2, *(3 + (i % 7) for i in range(197))]
        np.testing.assert_allclose(shown, expected, atol=0.01)

    @pytest.mark.thorough
    @given(seeds, st.integers(0, 8), st.integers(0, 8))
    def test_freezing_twice_is_freezing_at_the_earlier(self, seed, a, b):
        once = edits.freeze(trajectory(seed), [1, 2], at=min(a, b) * STEP)
        twice = edits.freeze(edits.freeze(trajectory(seed), [1, 2], at=a * STEP), [1, 2], at=b * STEP)
        assert_same(twice, once)

    def test_isolate_keeps_only_these_moving(self):
        edited = edits.isolate(trajectory(9), [1, 2])
        plays(edited, 9, range(9), parts=(1, 2))
        plays(edited, 9, [0] * 9, parts=(0, 3))
        assert_same(edits.isolate(edited, [1, 2]), edited)

    def test_isolating_for_a_while_lets_the_others_wait(self):
        edited = edits.isolate(trajectory(9), [1], begin=0.25, end=0.5)
        plays(edited, 9, [0, 1, 2, 2, 2, 3, 4, 5, 6], parts=(0, 2, 3))

    @pytest.mark.thorough
    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (lambda t: edits.speed(t, [1], 0.0), "factor: expected a number other than 0"),
            (
                lambda t: edits.speed(t, [1], 2.0, 0.5, 0.5),
                "end: expected a time after begin, 0.5 s, found 0.5",
            ),
            (lambda t: edits.loop(t, [1], 0.5, 0.25), "end: expected a time after begin"),
            (lambda t: edits.loop(t, [1], times=0), "times: expected 1 or more, found 0"),
            (lambda t: edits.freeze(t, [1], at=0.5, end=0.25), "end: expected a time after begin, 0.5 s"),
            (lambda t: edits.scale(t, [1], 0.0), "factor: expected more than 0, found 0"),
            (lambda t: edits.fade(t, [-1]), "parts: expected numbers from 0 to 3, found -1"),
        ],
    )
    def test_what_makes_no_sense_is_said(self, edit, message):
        with pytest.raises(ValueError, match=message):
            edit(trajectory(0))
