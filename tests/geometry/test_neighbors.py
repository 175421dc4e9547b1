"""Neighbour queries against brute force."""

import numpy as np

from gsjax.geometry.neighbors import nearest, neighbor_spacing, voxel_thin

POINTS = np.random.default_rng(0).uniform(size=(60, 3))


def distances(a, b):
    return np.linalg.norm(a[:, None] - b[None], axis=-1)


def test_nearest_equals_brute_force():
    queries = np.random.default_rng(1).uniform(size=(20, 3))
    index, distance = nearest(queries, POINTS)
    np.testing.assert_array_equal(index, distances(queries, POINTS).argmin(1))
    np.testing.assert_allclose(distance, distances(queries, POINTS).min(1))


def test_nearest_says_where_none_is_near():
    index, distance = nearest(np.array([[0.5, 0.5, 0.5], [9.0, 9.0, 9.0]]), POINTS, max_distance=0.5)
    assert (index[0] >= 0, index[1], distance[1]) == (True, -1, np.inf)
    index, distance = nearest(POINTS, np.zeros((0, 3)))
    assert (index == -1).all()
    assert np.isinf(distance).all()


def test_spacing_is_the_root_mean_square_of_the_three_nearest():
    three = np.sort(distances(POINTS, POINTS), axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbor_spacing(POINTS), np.sqrt((three**2).mean(1)))
    assert neighbor_spacing(POINTS[:2]).shape == (2,)
    np.testing.assert_array_equal(neighbor_spacing(POINTS[:1]), 0.01)
    assert neighbor_spacing(POINTS[:0]).shape == (0,)


def test_thinning_keeps_the_point_nearest_to_the_mean_of_each_voxel():
    kept = voxel_thin(POINTS, 0.3)
    cells = np.floor((POINTS - POINTS.min(0)) / 0.3).astype(int)
    assert len(kept) == len(np.unique(cells, axis=0))
    for i in kept:
        here = POINTS[(cells == cells[i]).all(1)]
        gap = np.linalg.norm(here - here.mean(0), axis=1).min()
        np.testing.assert_allclose(np.linalg.norm(POINTS[i] - here.mean(0)), gap)
    np.testing.assert_array_equal(voxel_thin(POINTS, 0.0), np.arange(60))
    assert len(voxel_thin(POINTS[:0], 0.3)) == 0
