"""Losses that do not depend on data: smooth planes, and uniform motion over time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gsjax.losses.regularization import plane_variation, second_differences


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
