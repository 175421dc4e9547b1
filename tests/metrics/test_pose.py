"""Pose errors against plain implementations of their definitions, and their invariances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import intrinsics
from gsjax.metrics.pose import (
    accuracy_auc,
    add_errors,
    add_s_errors,
    average_recall,
    diameter,
    fitted_poses,
    mspd,
    mssd,
    pose_errors,
    recall_within,
    score_poses,
)

seeds = st.integers(0, 10_000)
sizes = st.floats(0, 0.3)
FRAMES, VERTICES = 4, 90
IDENTITY = np.eye(4)[None]
K = intrinsics(500.0, 640, 480)


def motions(rng, count, size=1.0):
    """Random rigid motions, whose rotations and translations scale with `size`."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(size * rng.normal(size=(count, 3))).as_matrix()
    poses[:, :3, 3] = size * rng.normal(size=(count, 3))
    return poses


def problem(seed, size=0.05):
    """Slightly wrong estimated poses, true poses, and points of the model."""
    rng = np.random.default_rng(seed)
    true = motions(rng, FRAMES)
    return true @ motions(rng, FRAMES, size), true, 0.05 * rng.normal(size=(VERTICES, 3))


def placed(pose, points):
    return points @ pose[:3, :3].T + pose[:3, 3]


def quarter_turns():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(4), [0, 0, np.pi / 2])).as_matrix()
    return poses


def in_front(poses):
    """The poses, moved closer together and two metres in front of a camera at the origin."""
    moved = poses.copy()
    moved[:, :3, 3] = 0.1 * poses[:, :3, 3] + [0, 0, 2]
    return moved


@given(seeds)
def test_errors_are_their_definitions(seed):
    estimated, true, points = problem(seed)
    for t in range(FRAMES):
        there, here = placed(estimated[t], points), placed(true[t], points)
        gaps = np.linalg.norm(here[:, None] - there[None], axis=-1)
        assert add_errors(estimated, true, points)[t] == pytest.approx(np.diagonal(gaps).mean())
        assert add_s_errors(estimated, true, points)[t] == pytest.approx(gaps.min(axis=1).mean())
        distance, angle = (errors[t] for errors in pose_errors(estimated, true))
        turn = Rotation.from_matrix(estimated[t, :3, :3] @ true[t, :3, :3].T)
        assert distance == pytest.approx(np.linalg.norm(estimated[t, :3, 3] - true[t, :3, 3]))
        assert angle == pytest.approx(np.degrees(turn.magnitude()))


@given(seeds, sizes)
def test_bop_errors_are_their_definitions(seed, size):
    estimated, true, points = problem(seed, size)
    estimated, true = in_front(estimated), in_front(true)
    symmetries, views = quarter_turns(), np.tile(np.eye(4), (FRAMES, 1, 1))
    surface = mssd(estimated, true, points, symmetries)
    projected = mspd(estimated, true, points, symmetries, views, np.tile(K, (FRAMES, 1, 1)))
    for t in range(FRAMES):
        there = placed(estimated[t], points)
        others = [placed(true[t] @ symmetry, points) for symmetry in symmetries]
        assert min(there[:, 2].min(), *(other[:, 2].min() for other in others)) > 0
        largest = [np.linalg.norm(there - other, axis=-1).max() for other in others]
        assert surface[t] == pytest.approx(min(largest))
        pixels, *pictures = ((a @ K.T)[:, :2] / a[:, 2:] for a in (there, *others))
        largest = [np.linalg.norm(pixels - picture, axis=-1).max() for picture in pictures]
        assert projected[t] == pytest.approx(min(largest))


@given(seeds, sizes)
def test_the_nearest_points_are_nearer_than_the_same_and_all_are_nearer_than_the_farthest(seed, size):
    estimated, true, points = problem(seed, size)
    add, add_s = add_errors(estimated, true, points), add_s_errors(estimated, true, points)
    assert (add_s <= add + 1e-12).all()
    assert (add <= mssd(estimated, true, points, IDENTITY) + 1e-12).all()


@given(seeds)
def test_equal_poses_have_no_error(seed):
    _, true, points = problem(seed)
    score = score_poses(true, true, points, diameter(points))
    assert score == pytest.approx((0, 0, 1, 1, 1, 1, 1), abs=1e-6)
    assert mssd(true, true, points, quarter_turns()) == pytest.approx(np.zeros(FRAMES), abs=1e-9)


@given(seeds, st.integers(0, 3))
def test_a_turn_by_a_symmetry_shows_in_add_alone(seed, quarters):
    _, true, points = problem(seed)
    symmetries = quarter_turns()
    square = np.concatenate([placed(symmetry, points) for symmetry in symmetries])
    turned = true @ symmetries[quarters]
    assert add_s_errors(turned, true, square) == pytest.approx(np.zeros(FRAMES), abs=1e-9)
    assert mssd(turned, true, square, symmetries) == pytest.approx(np.zeros(FRAMES), abs=1e-9)
    assert (add_errors(turned, true, square) > 1e-3).all() == (quarters > 0)


@given(seeds, sizes)
def test_a_motion_of_the_world_or_another_frame_of_the_model_changes_nothing(seed, size):
    estimated, true, points = problem(seed, size)
    rng = np.random.default_rng(seed + 1)
    world, inner = motions(rng, 1)[0], motions(rng, 1)[0]
    own = placed(np.linalg.inv(inner), points)
    symmetries = quarter_turns()
    conjugate = np.linalg.inv(inner) @ symmetries @ inner
    for error in (add_errors, add_s_errors):
        expected = pytest.approx(error(estimated, true, points), abs=1e-9)
        assert error(world @ estimated, world @ true, points) == expected
        assert error(estimated @ inner, true @ inner, own) == expected
    expected = pytest.approx(mssd(estimated, true, points, symmetries), abs=1e-9)
    assert mssd(world @ estimated, world @ true, points, symmetries) == expected
    assert mssd(estimated @ inner, true @ inner, own, conjugate) == expected
    for moved, errors in zip(
        pose_errors(world @ estimated, world @ true), pose_errors(estimated, true), strict=True
    ):
        assert moved == pytest.approx(errors, abs=1e-6)


def test_the_area_of_no_error_is_one_and_of_large_ones_none():
    assert accuracy_auc(np.zeros(3)) == 1
    assert accuracy_auc(np.array([0.1, 0.2, np.inf])) == 0
    assert accuracy_auc(np.array([0.04, 0.2])) == pytest.approx(0.5)
    with pytest.raises(ValueError, match="at least one frame, found none"):
        accuracy_auc(np.zeros(0))


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=40))
def test_the_area_is_that_of_the_toolbox_and_next_to_the_integral(errors):
    errors = np.array(errors)
    # As in the toolbox: the accuracy reaches k / n at the k-th of n errors, and each step that ends at an
    # error is as high as the accuracy there.
    kept, toolbox, last = sorted(error for error in errors if error < 0.1), 0.0, 0.0
    for k, error in enumerate(kept, start=1):
        toolbox += (error - last) / 0.1 * k / len(errors)
        last = error
    toolbox += (0.1 - last) / 0.1 * len(kept) / len(errors)
    area = accuracy_auc(errors)
    assert area == pytest.approx(toolbox, abs=1e-9)
    thresholds = np.linspace(0, 0.1, 4001)
    curve = (errors[:, None] <= thresholds).mean(axis=0)
    integral = 10 * np.trapezoid(curve, thresholds)
    assert integral - 1e-3 <= area <= integral + 1 / len(errors) + 1e-3
    assert area == pytest.approx(
        np.maximum(0, 1 - 10 * errors).mean() + 10 * max(kept, default=0) / len(errors)
    )


def test_recall_counts_frames_within_both_bounds():
    true = np.tile(np.eye(4), (4, 1, 1))
    estimated = true.copy()
    estimated[1, 0, 3] = 0.051
    estimated[2, :3, :3] = Rotation.from_euler("y", 5.1, degrees=True).as_matrix()
    estimated[3, :3, :3] = Rotation.from_euler("y", 4.9, degrees=True).as_matrix()
    estimated[3, 0, 3] = 0.049
    assert recall_within(estimated, true) == 0.5
    assert recall_within(estimated, true, metres=0.02) == 0.25
    assert average_recall(np.array([0.0, 1.5, 9.0]), np.array([1.0, 2.0])) == pytest.approx(0.5)


def test_a_vertex_behind_the_camera_is_infinitely_far_off():
    view = np.eye(4)[None]
    ahead, behind = view.copy(), view.copy()
    ahead[0, 2, 3], behind[0, 2, 3] = 1.0, -1.0
    for estimated, true in ((ahead, behind), (behind, ahead), (behind, behind)):
        assert mspd(estimated, true, np.zeros((1, 3)), IDENTITY, view, K[None]) == [np.inf]


@given(seeds, sizes)
def test_poses_are_those_that_the_points_went_through(seed, size):
    _, true, points = problem(seed, size)
    means = np.stack([placed(pose, points) for pose in true])
    np.testing.assert_allclose(fitted_poses(means, true[0]), true, atol=1e-8)
    # For points that do not move rigidly, no other motion fits better.
    rng = np.random.default_rng(seed)
    means = means + 0.01 * rng.normal(size=means.shape)
    fitted = fitted_poses(means, np.eye(4))
    squares = [np.square(placed(fitted[1], means[0]) - means[1]).sum()]
    for nudge in motions(rng, 8, 1e-3):
        squares.append(np.square(placed(nudge @ fitted[1], means[0]) - means[1]).sum())
    assert np.argmin(squares) == 0
    assert np.linalg.det(fitted[:, :3, :3]) == pytest.approx(np.ones(FRAMES))


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.outer(np.linspace(-1, 1, 5), [1.0, 2.0, 0.5])])
def test_a_rotation_that_points_leave_open_is_none(points):
    still = fitted_poses(np.stack([points, points + np.eye(3)[2]]), np.eye(4))
    np.testing.assert_allclose(still[:, :3, :3], np.tile(np.eye(3), (2, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(still[:, 2, 3], [0, 1], atol=1e-6)


def test_the_diameter_is_that_of_all_pairs():
    points = np.random.default_rng(0).normal(size=(2500, 3))
    assert diameter(points) == pytest.approx(
        max(np.linalg.norm(points - point, axis=-1).max() for point in points)
    )
    assert diameter(points[:1]) == 0


def test_what_cannot_be_scored_is_named():
    estimated, true, points = problem(0)
    with pytest.raises(ValueError, match="found 3 for 4"):
        score_poses(estimated[1:], true, points, 1.0)
    with pytest.raises(ValueError, match="found 0 for 0"):
        score_poses(estimated[:0], true[:0], points, 1.0)
    with pytest.raises(ValueError, match="at least one point of the model, found none"):
        score_poses(estimated, true, points[:0], 1.0)
