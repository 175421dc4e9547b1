"""Losses that do not depend on data: smooth planes, uniform motion over time, and strains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from gsjax.losses.regularization import local_strain, plane_variation, pseudo_huber, second_differences


def planes(seed=0, times=5):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(3, times, 4, 2)))


@pytest.mark.usefixtures("x64")
class TestPlanes:
    def test_variation_is_of_neighbours_along_both_axes(self):
        a = np.asarray(planes())
        expected = np.mean((a[:, 1:] - a[:, :-1]) ** 2) + np.mean((a[:, :, 1:] - a[:, :, :-1]) ** 2)
        np.testing.assert_allclose(plane_variation(jnp.asarray(a)), expected)

    def test_what_is_the_same_everywhere_costs_nothing(self):
        assert plane_variation(jnp.full((3, 4, 4, 2), 7.0)) == 0

    def test_what_moves_evenly_costs_nothing(self):
        start, pace = planes(1)[:, :1], planes(2)[:, :1]
        even = start + pace * jnp.arange(5.0)[:, None, None]
        np.testing.assert_allclose(second_differences(even), 0, atol=1e-24)
        a = np.asarray(planes())
        np.testing.assert_allclose(
            second_differences(planes()), np.mean((a[:, 2:] - 2 * a[:, 1:-1] + a[:, :-2]) ** 2)
        )

    def test_two_times_have_no_second_difference(self):
        assert second_differences(planes(times=2)) == 0

    @pytest.mark.parametrize("loss", [plane_variation, second_differences])
    def test_slopes(self, loss):
        check_grads(jax.jit(loss), (planes(),), order=1)


NEIGHBORS = jnp.array([[0, 1, 2], [1, 0, 3], [2, 3, 0], [3, 2, 1]])


def points(seed=0):
    return np.random.default_rng(seed).normal(size=(4, 3))


def strains(rest, moved, turns):
    return local_strain(*map(jnp.asarray, (rest, moved, turns)), NEIGHBORS)


@pytest.mark.usefixtures("x64")
class TestStrain:
    def test_a_rigid_motion_has_none(self):
        turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
        rest = points()
        found = strains(rest, rest @ turn.T + [1.0, 2.0, 3.0], np.tile(turn, (4, 1, 1)))
        np.testing.assert_allclose(found, 0, atol=1e-28)

    @pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
    def test_that_of_growth_is_its_share_in_any_unit(self, unit):
        rest = unit * points()
        found = strains(rest, 1.2 * rest, np.tile(np.eye(3), (4, 1, 1)))
        expected = np.where(np.arange(4)[:, None] == NEIGHBORS, 0, 0.2**2)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-20)

    def test_gradients_are_central_differences_also_of_points_in_one_place(self):
        rest = points()
        rest[3] = rest[1]
        turns = Rotation.from_rotvec(points(1)).as_matrix()

        def penalty(moved, turns):
            return pseudo_huber(strains(rest, moved, turns), 0.1).sum()

        check_grads(penalty, (rest + 0.1 * points(2), turns), order=1, modes=("fwd", "rev"))

    def test_it_pulls_no_rest_apart_where_all_is_stretched_alike(self):
        """Canonical points move the deformed ones too: under a field that stretches evenly, the strain does
        not depend on their scale, so its gradient has no component along it."""
        stretch, turns = jnp.array([1.3, 1.0, 1.0]), np.tile(np.eye(3), (4, 1, 1))

        def penalty(rest):
            return pseudo_huber(strains(rest, stretch * rest, turns), 0.1).sum()

        rest = jnp.asarray(points())
        check_grads(penalty, (rest,), order=1, modes=("fwd", "rev"))
        slope = jax.grad(penalty)(rest)
        assert np.abs(slope).max() > 1e-3
        np.testing.assert_allclose(np.vdot(slope, rest), 0, atol=1e-12)

    def test_the_penalty_is_a_square_at_first_and_then_a_line(self):
        lengths = np.array([0.0, 1e-4, 1e3])
        np.testing.assert_allclose(
            pseudo_huber(jnp.square(lengths), 0.1), [0, 1e-8 / 0.2, 1e3 - 0.1], rtol=1e-4, atol=1e-15
        )

    def test_a_point_that_left_is_drawn_back_by_its_neighbours(self):
        rest = jnp.asarray(points())

        def penalty(moved):
            return pseudo_huber(strains(rest, moved, np.tile(np.eye(3), (4, 1, 1))), 0.1).sum()

        @jax.jit
        def descended(moved):
            return jax.lax.fori_loop(0, 3000, lambda _, at: at - 3e-3 * jax.grad(penalty)(at), moved)

        moved = np.asarray(descended(rest.at[2, 0].add(3.0)))
        apart = moved - np.asarray(rest)
        np.testing.assert_allclose(apart, np.broadcast_to(apart.mean(0), (4, 3)), atol=0.1)
