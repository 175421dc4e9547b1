"""Farthest-point sampling: the picked points cover the others and are far from each other."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.distance import cdist

from gsjax.geometry.sampling import farthest_points

pick = jax.jit(farthest_points, static_argnums=1)


@pytest.mark.usefixtures("x64")
@given(st.integers(0, 1000), st.integers(1, 12))
def test_picked_points_cover_the_others_and_keep_apart(seed, there):
    random = np.random.default_rng(seed)
    points, valid = random.normal(size=(12, 3)), random.permutation(12) < there
    points[~valid] *= 100
    points[np.nonzero(~valid)[0][:1]] = np.nan
    sample = pick(jnp.asarray(points), 5, jnp.asarray(valid))
    picked = np.asarray(sample.indices)[np.asarray(sample.valid)]
    assert len(set(picked)) == len(picked) == min(there, 5)
    assert valid[picked].all()
    center = points[valid].mean(0)
    far = np.where(valid, np.linalg.norm(points - center, axis=1), -1)
    np.testing.assert_allclose(far[picked[0]], far.max())  # two points are equally far from their mean
    for i in range(1, len(picked)):  # each is the farthest from those before it
        apart = np.where(valid, cdist(np.nan_to_num(points), points[picked[:i]]).min(1), -1)
        np.testing.assert_allclose(apart[picked[i]], apart.max())


def test_points_at_one_place_are_picked_once_and_none_where_there_is_none():
    points = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert pick(points, 4, None).valid.tolist() == [True, True, False, False]
    assert pick(points[:1], 4, None).valid.tolist() == [True, False, False, False]
    assert not pick(points, 4, jnp.zeros(4, bool)).valid.any()
    assert not pick(points * jnp.nan, 4, None).valid.any()


def test_a_batch_is_a_loop():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(3, 8, 3)))
    sampled = jax.vmap(lambda p: pick(p, 4, None))(points)
    for i in range(3):
        np.testing.assert_array_equal(sampled.indices[i], pick(points[i], 4, None).indices)


def test_a_count_below_one_is_named():
    with pytest.raises(ValueError, match="count: expected 1 or more, found 0"):
        farthest_points(jnp.zeros((4, 3)), 0)
