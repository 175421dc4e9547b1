"""Neighbour queries against brute force."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gsjax.geometry.neighbors import drop_flying_pixels, nearest, neighbor_spacing, voxel_thin

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


def slope(height=24, width=32):
    return np.float32(1 + np.linspace(0, 0.5, width) + np.linspace(0, 0.2, height)[:, None])


@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 0.2, 0.4]))
def test_depth_that_stands_alone_is_on_no_surface(seed, holes):
    """5 % of the pixels have a tenth to ten times their true depth."""
    random, surface = np.random.default_rng(seed), slope(96, 128)
    off, known = random.uniform(size=surface.shape) < 0.05, random.uniform(size=surface.shape) >= holes
    wrong = surface * 10 ** random.uniform(-1, 1, surface.shape).astype(np.float32)
    found = drop_flying_pixels(np.where(known, np.where(off, wrong, surface), 0))
    far = off & known & (np.abs(wrong - surface) > 0.1 * surface)
    assert (found[far] > 0).mean() < 0.06 + 0.25 * holes
    right = ~off & known
    assert (found[right] == surface[right]).mean() > 0.98
    assert (found[~known] == 0).all()


def test_surfaces_edges_lines_and_sparse_depth_are_kept():
    scene = slope()
    scene[8:16, 10:20] = 0.7
    scene[4, 2:30] = 0.5
    scene[:, 31] = 0
    kept = drop_flying_pixels(np.stack([scene, scene]))
    ends = np.zeros(scene.shape, bool)
    ends[4, [2, 29]] = True
    assert (kept == np.where(ends, 0, scene)).all()
    lidar = np.where(np.arange(24 * 32).reshape(24, 32) % 3 == 0, np.geomspace(1, 9, 32, dtype=np.float32), 0)
    assert (drop_flying_pixels(lidar) == lidar).all()
    for endless in (np.nan, np.inf, 1e10):
        assert drop_flying_pixels(np.full((5, 5), endless)).sum() == 0
