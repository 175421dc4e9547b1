"""Points from posed photographs of a wall with known geometry."""

import cv2
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.perception.matching import filled_up, match_points

WIDTH, HEIGHT = 160, 120
K = intrinsics(150.0, WIDTH, HEIGHT)


def wall_seen_from(eyes, seed=0):
    """Images of a patterned square of 2 m at z = 0, with view matrices and intrinsics."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0, 255, (40, 40, 3)).astype(np.uint8)
    texture = cv2.resize(coarse, (800, 800), interpolation=cv2.INTER_CUBIC)
    on_wall = np.array([[2 / 800, 0, -1], [0, 2 / 800, -1], [0, 0, 1]])  # texture's pixels to metres
    viewmats = np.stack([look_at(np.array(eye, float), np.array([0.1, 0.0, 0.0])) for eye in eyes])
    pictures = []
    for viewmat in viewmats:
        plane = np.stack([viewmat[:3, 0], viewmat[:3, 1], viewmat[:3, 3]], axis=1)
        homography = np.diag([1.0, 1.0, 1.0]) @ K @ plane @ on_wall
        shifted = (
            np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ homography
        )  # OpenCV's pixel centres are at integers
        pictures.append(cv2.warpPerspective(texture, shifted, (WIDTH, HEIGHT), flags=cv2.INTER_AREA))
    return pictures, viewmats, np.tile(K, (len(eyes), 1, 1))


EYES = [(-0.3, -0.3, 1.6), (0.0, -0.3, 1.6), (0.3, -0.2, 1.5), (0.1, 0.3, 1.7)]


@pytest.fixture(scope="module")
def wall():
    return wall_seen_from(EYES)


def test_points_lie_where_photographs_meet(wall):
    _, viewmats, Ks = wall
    matched = match_points(*wall)
    assert len(matched.points) > 100
    assert np.median(np.abs(matched.points[:, 2])) < 0.003  # 13 mm if pixel centres were off by half a pixel
    assert np.quantile(np.abs(matched.points[:, 2]), 0.95) < 0.05
    for v, rows in enumerate(matched.shown):
        assert len(rows) > 10
        local = matched.points[rows] @ viewmats[v, :3, :3].T + viewmats[v, :3, 3]
        seen = (local @ Ks[v].T)[:, :2] / local[:, 2:]
        assert ((seen > -2) & (seen < (WIDTH + 2, HEIGHT + 2))).all()
    assert ((matched.colors >= 0) & (matched.colors <= 1)).all()


def test_what_is_between_is_as_far_away(wall):
    pictures, viewmats, Ks = wall
    matched = match_points(*wall)
    points, colors = filled_up(matched, pictures, viewmats, Ks, 2_000)
    assert points.shape == colors.shape == (2_000, 3)
    np.testing.assert_array_equal(points[: len(matched.points)], matched.points)
    assert np.median(np.abs(points[:, 2])) < 0.02
    again, _ = filled_up(matched, pictures, viewmats, Ks, 2_000)
    np.testing.assert_array_equal(points, again)
    few, _ = filled_up(matched, pictures, viewmats, Ks, 50)
    assert len(few) == 50
    assert {tuple(row) for row in few} <= {tuple(row) for row in matched.points}


def test_what_is_masked_does_not_count(wall):
    pictures, viewmats, Ks = wall
    left = np.zeros((HEIGHT, WIDTH), bool)
    left[:, : WIDTH // 2] = True
    matched = match_points(pictures, viewmats, Ks, [left, None, None, None])
    local = matched.points[matched.shown[0]] @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    assert ((local @ K.T)[:, 0] / local[:, 2]).max() < WIDTH / 2 + 2


def test_photographs_that_share_nothing(wall):
    pictures, viewmats, Ks = wall
    grey = [np.full_like(picture, 128) for picture in pictures]
    matched = match_points(grey, viewmats, Ks)
    assert matched.points.shape == (0, 3)
    assert [len(rows) for rows in matched.shown] == [0] * 4
    assert filled_up(matched, grey, viewmats, Ks, 100)[0].shape == (0, 3)
    same_place = np.tile(viewmats[:1], (4, 1, 1))
    assert len(match_points(pictures, same_place, Ks).points) == 0
    others = wall_seen_from(EYES[1:2], seed=1)[0]
    unrelated = match_points([pictures[0], *others], viewmats[:2], Ks[:2])
    assert len(unrelated.points) < 5
    alone = match_points(pictures[:1], viewmats[:1], Ks[:1])
    assert len(alone.points) == 0


def test_large_photographs_are_matched_in_small(wall, monkeypatch):
    pictures, viewmats, Ks = wall
    masks = [np.arange(WIDTH) < 100 + np.zeros((HEIGHT, 1)), None, None, None]
    monkeypatch.setattr("gsjax.perception.matching._LARGEST", WIDTH)
    large = [cv2.resize(p, (2 * WIDTH, 2 * HEIGHT), interpolation=cv2.INTER_CUBIC) for p in pictures]
    matched = match_points(
        large,
        viewmats,
        np.diag([2.0, 2.0, 1.0]) @ Ks,
        [np.repeat(np.repeat(masks[0], 2, 0), 2, 1), None, None, None],
    )
    assert len(matched.points) > 100
    assert np.median(np.abs(matched.points[:, 2])) < 0.004
    same = match_points(pictures, viewmats, Ks, masks)
    assert len(matched.points) == pytest.approx(len(same.points), rel=0.2)
