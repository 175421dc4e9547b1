"""Tracking errors: zero for the true motion, analytic for known mistakes; true labels at occlusion edges."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.metrics.tracking import relative_motion, score_object, score_tracks, true_labels

FRAMES, COUNT = 7, 40


def motion(seed=0):
    """Random rigid poses, and points that follow them without error."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, :3] = Rotation.random(FRAMES, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(FRAMES, 3))
    local = 0.1 * rng.normal(size=(COUNT, 3)) + [0.02, 0, 0]
    means = np.einsum("tij,nj->tni", poses[:, :3, :3], local) + poses[:, None, :3, 3]
    return means, poses


def test_perfect_motion_has_no_error():
    means, poses = motion()
    score = score_object(means, poses)
    assert score.centroid_error_mm == pytest.approx(0, abs=1e-9)
    assert score.point_error_mm == pytest.approx(0, abs=1e-9)
    assert score.median_point_error_mm == pytest.approx(0, abs=1e-9)
    assert score.num_scored == COUNT
    distances = np.linalg.norm(means.mean(1) - means[0].mean(0), axis=-1)
    assert score.moved_mm == pytest.approx(1000 * distances.max())


def test_a_constant_offset_after_the_first_frame():
    means, poses = motion()
    means[1:] += np.array([0.003, 0.0, 0.004])
    score = score_object(means, poses)
    np.testing.assert_allclose(score.centroid_errors_mm, [0, *[5.0] * (FRAMES - 1)], atol=1e-9)
    assert score.centroid_error_mm == pytest.approx(5 * (FRAMES - 1) / FRAMES)
    assert score.point_error_mm == pytest.approx(5 * (FRAMES - 1) / FRAMES)
    assert score.median_point_error_mm == pytest.approx(5)


def test_a_missed_rotation_shows_in_the_points_and_not_in_the_centroid():
    angle, radius = np.radians(60), 0.05
    phases = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = radius * np.stack([np.cos(phases), np.sin(phases), 0 * phases], axis=1)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    score = score_object(np.stack([ring, ring]), poses)
    chord = 1000 * 2 * radius * np.sin(angle / 2)
    assert score.centroid_error_mm == pytest.approx(0, abs=1e-9)
    assert score.point_error_mm == pytest.approx(chord / 2)  # frame 0 has none
    assert score.turned_deg == pytest.approx(60)
    assert score.moved_mm == pytest.approx(0, abs=1e-9)


def test_objects_are_scored_apart_and_unknown_gaussians_not_at_all():
    means, poses = motion()
    labels = np.repeat([2, 3, -1, 0], COUNT // 4)
    means[1:, labels == 3] += [0.01, 0, 0]
    means[1:, labels == -1] += 5.0
    scores = score_tracks(means, labels, {2: poses, 3: poses, 9: poses})
    assert scores[2].point_error_mm == pytest.approx(0, abs=1e-9)
    assert scores[3].median_point_error_mm == pytest.approx(10)
    assert scores[9].num_scored == 0
    assert math.isnan(scores[9].point_error_mm)
    assert scores[2].num_scored == COUNT // 4


def test_bad_truth_is_refused():
    means, poses = motion()
    broken = poses.copy()
    broken[3, :3, :3] *= 1.01
    with pytest.raises(ValueError, match="expected rotations, found none at frame 3"):
        relative_motion(broken)
    mirrored = poses.copy()
    mirrored[2, :, 0] *= -1
    with pytest.raises(ValueError, match="expected rotations, found none at frame 2"):
        relative_motion(mirrored)
    broken[3] = np.nan
    with pytest.raises(ValueError, match="frame 3"):
        relative_motion(broken)
    with pytest.raises(ValueError, match="expected 7 frames like poses, found 6"):
        score_object(means[1:], poses)
    with pytest.raises(ValueError, match=r"labels: expected shape \[40\] to match means, found \(3,\)"):
        score_tracks(means, np.zeros(3, int), {})
    with pytest.raises(ValueError, match=r"expected shape \[T, 4, 4\]"):
        relative_motion(poses[:0])


def box_before_wall():
    depth, mask = np.full((24, 32), 2.0), np.zeros((24, 32), np.uint8)
    depth[8:16, 10:20], mask[8:16, 10:20] = 1.0, 5
    return mask, depth


def test_true_labels_need_the_depth_to_agree():
    K = intrinsics(40.0, 32, 24)
    mask, depth = box_before_wall()
    points = np.array(
        [[0, 0, 1.0], [0, 0, 1.014], [0, 0, 1.016], [0, 0, 2.0], [0.7, 0, 2.0], [9, 0, 2], [0, 0, -1]]
    )
    labels = true_labels(points, [mask], [depth], [np.eye(4)], [K])
    np.testing.assert_array_equal(labels, [5, 5, -1, -1, 0, -1, -1])
    np.testing.assert_array_equal(true_labels(points, [], [], [], []), -1)


def test_the_camera_whose_depth_agrees_best_decides():
    K = intrinsics(40.0, 32, 24)
    mask, depth = box_before_wall()
    point = np.array([[0.0, 0.0, 1.01]])  # 10 mm behind the first camera's surface
    from_above = look_at(np.array([0.0, -1.0, 1.01]), point[0])
    other_mask, other_depth = np.full((24, 32), 7, np.uint8), np.full((24, 32), 1.001)
    views = ([mask, other_mask], [depth, other_depth], [np.eye(4), from_above], [K, K])
    np.testing.assert_array_equal(true_labels(point, *views), [7])
    np.testing.assert_array_equal(true_labels(point, *(each[::-1] for each in views)), [7])
    np.testing.assert_array_equal(true_labels(point, *(each[:1] for each in views)), [5])


def test_views_that_do_not_belong_together_are_named():
    K = intrinsics(40.0, 32, 24)
    mask, depth = box_before_wall()
    with pytest.raises(ValueError, match="found 2 masks, 1 depths"):
        true_labels(np.zeros((1, 3)), [mask, mask], [depth], [np.eye(4)], [K])
    with pytest.raises(ValueError, match=r"masks: expected shape \(24, 32\) .* found \(23, 32\)"):
        true_labels(np.zeros((1, 3)), [mask[1:]], [depth], [np.eye(4)], [K])


def test_what_was_begun_later_is_counted_from_there():
    """Frames before the anchor count too: the error equals that of reordered frames."""
    means, poses = motion()
    means = means + 0.01 * np.random.default_rng(1).normal(size=means.shape)
    order = [3, 0, 1, 2, 4, 5, 6]
    anchored, reordered = score_object(means, poses, anchor=3), score_object(means[order], poses[order])
    assert anchored.centroid_errors_mm[3] == pytest.approx(0, abs=1e-9)
    np.testing.assert_allclose(anchored.centroid_errors_mm[order], reordered.centroid_errors_mm)
    for name in ("point_error_mm", "median_point_error_mm", "moved_mm", "turned_deg"):
        assert getattr(anchored, name) == pytest.approx(getattr(reordered, name))
    assert anchored.point_error_mm != pytest.approx(score_object(means, poses).point_error_mm)
    labels = np.zeros(COUNT, int)
    assert score_tracks(means, labels, {0: poses}, anchor=3)[0].moved_mm == anchored.moved_mm
    np.testing.assert_allclose(relative_motion(poses, anchor=3)[3], np.eye(4), atol=1e-12)
