"""Motions of groups, against SciPy's rotations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.track.motion import (
    Motion,
    Pose,
    facing,
    first_pose,
    group_means,
    move,
    place,
)
from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.gaussians import gaussians_from_activated

GROUPS = np.array([1, 2, 1, 2, 2, 1, 1])
COUNT = len(GROUPS)


@pytest.fixture
def pose():
    rng = np.random.default_rng(0)
    quats = Rotation.random(COUNT, rng=1).as_quat(scalar_first=True)
    return Pose(jnp.asarray(rng.normal(size=(COUNT, 3)), jnp.float32), jnp.asarray(quats, jnp.float32))


@pytest.fixture
def motion():
    rng = np.random.default_rng(2)
    parts = (rng.normal(size=(2, 6)), 0.01 * rng.normal(size=(COUNT, 3)))
    return Motion(*(jnp.asarray(a, jnp.float32) for a in parts))


def test_group_means_are_numpys_and_zero_for_nobody(pose):
    means = group_means(pose.means, jnp.asarray(GROUPS), 3)
    for k in (1, 2):
        np.testing.assert_allclose(means[k - 1], pose.means[k == GROUPS].mean(0), atol=1e-6)
    np.testing.assert_array_equal(means[2], 0)
    assert group_means(jnp.ones(COUNT), jnp.asarray(GROUPS), 2).shape == (2,)


def test_move_is_scipys_rotation_about_the_centre_then_the_shifts(pose, motion):
    centers = group_means(pose.means, jnp.asarray(GROUPS), 2)
    moved = move(pose, motion, centers, jnp.asarray(GROUPS))
    for i, k in enumerate(GROUPS - 1):
        turn = Rotation.from_rotvec(motion.twists[k, 3:])
        shift = centers[k] + motion.twists[k, :3] + motion.delta[i]
        expected = turn.apply(pose.means[i] - centers[k]) + shift
        np.testing.assert_allclose(moved.means[i], expected, atol=1e-5)


def test_turning_about_the_centroid_keeps_it(pose, motion):
    groups = jnp.asarray(GROUPS)
    centers = group_means(pose.means, groups, 2)
    turning = Motion(motion.twists.at[:, :3].set(0.0), jnp.zeros_like(motion.delta))
    turned = move(pose, turning, centers, groups).means
    np.testing.assert_allclose(group_means(turned, groups, 2), centers, atol=1e-5)
    assert float(jnp.abs(turned - pose.means).max()) > 0.1


def test_orientations_follow_so_covariances_turn_with_their_group(pose, motion):
    moved = move(pose, motion, jnp.zeros((2, 3)), jnp.asarray(GROUPS))
    shape = np.diag([0.3, 0.1, 0.02]) ** 2

    def covariances(quats):
        axes = np.asarray(quats_to_matrices(quats))
        return axes @ shape @ axes.transpose(0, 2, 1)

    turns = Rotation.from_rotvec(np.asarray(motion.twists)[GROUPS - 1, 3:]).as_matrix()
    expected = turns @ covariances(pose.quats) @ turns.transpose(0, 2, 1)
    np.testing.assert_allclose(covariances(moved.quats), expected, atol=1e-6)


def test_no_motion_has_a_gradient_without_nan(pose):
    still = Motion(jnp.zeros((2, 6)), jnp.zeros((COUNT, 3)))
    groups, centers = jnp.asarray(GROUPS), jnp.zeros((2, 3))
    moved = move(pose, still, centers, groups)
    np.testing.assert_allclose(moved.means, pose.means, atol=1e-6)

    def total(motion):
        moved = move(pose, motion, centers, groups)
        return (moved.means**2).sum() + (moved.quats * jnp.arange(4.0)).sum()

    for gradient in jax.tree.leaves(jax.jit(jax.grad(total))(still)):
        assert jnp.isfinite(gradient).all()


def scene_of(pose: Pose, normals) -> TrackedScene:
    """A scene of the pose's Gaussians and two of the background behind them."""
    means, quats = np.asarray(pose.means), np.asarray(pose.quats)
    gaussians = gaussians_from_activated(
        np.concatenate([means, [[0, 0, -5.0], [0, 0, -6.0]]]),
        np.concatenate([quats, [[1.0, 0, 0, 0]] * 2]),
        np.full((COUNT + 2, 3), 0.1),
        np.full(COUNT + 2, 0.9),
        np.full((COUNT + 2, 3), 0.5),
    )
    labels = jnp.asarray([*GROUPS, 0, 0], jnp.int32)
    return TrackedScene(gaussians, jnp.asarray(normals, jnp.float32), labels, (0, 4, 9), COUNT)


def test_place_moves_what_can_move_and_nothing_else(pose):
    scene = scene_of(pose, np.zeros((COUNT, 3)))
    np.testing.assert_allclose(first_pose(scene).means, pose.means)
    placed = place(scene, eqx.tree_at(lambda p: p.means, pose, pose.means + 1))
    np.testing.assert_allclose(placed.means[:COUNT], pose.means + 1)
    np.testing.assert_array_equal(placed.means[COUNT:], scene.gaussians.means[COUNT:])
    np.testing.assert_array_equal(placed.logit_opacities, scene.gaussians.logit_opacities)


@pytest.mark.thorough
def test_a_surface_shows_its_front_and_hides_its_back(pose):
    axes = np.asarray(quats_to_matrices(pose.quats))
    normals = np.tile([0.0, 0.0, 1.0], (COUNT, 1))
    normals[1] = 0  # two-sided
    scene = scene_of(pose, normals)
    for i in range(COUNT):
        front, back = pose.means[i] + 2 * axes[i, :, 2], pose.means[i] - 2 * axes[i, :, 2]
        share = facing(scene, pose, jnp.stack([front, back]))
        assert share.shape == (2, COUNT + 2)
        np.testing.assert_allclose(share[:, i], [1, 1] if i == 1 else [1, 0], atol=1e-6)
        np.testing.assert_array_equal(share[:, COUNT:], 1)
    edge = facing(scene, pose, (pose.means[0] + 2 * axes[0, :, 0])[None])
    np.testing.assert_allclose(edge[0, 0], 0.5, atol=1e-5)
