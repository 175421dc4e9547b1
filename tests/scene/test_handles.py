"""Handles move Gaussians: rigidly for one handle, smoothly between several, and always to finite values."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.handles import HandlePose, at_rest, blend_quats, skin, skin_means

BLENDS = ("quaternion", "polar", "dual")
seeds = st.integers(0, 10_000)
skinned = jax.jit(skin, static_argnums=4)
matrices = jax.jit(quats_to_matrices)


@partial(jax.jit, static_argnames="blend")
def means_and_turns(gaussians, weights, quats, translations, centers, blend):
    moved = skin(gaussians, weights, centers, HandlePose(quats, translations), blend)
    return moved.means, quats_to_matrices(moved.quats)


def made_up(seed, num=7, parts=3, most=2.0):
    """Random Gaussians, weights, centres and a pose; handles rotate by at most `most` radians."""
    rng = np.random.default_rng(seed)
    shapes = ((num, 3), (num, 4), (num, 3), (num,), (num, 1, 3))
    gaussians = Gaussians(*(jnp.asarray(rng.normal(size=shape)) for shape in shapes))
    weights = rng.dirichlet(np.ones(parts), num)
    centers = rng.normal(size=(parts, 3))
    axes = rng.normal(size=(parts, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = Rotation.from_rotvec(axes * rng.uniform(0, most, (parts, 1))).as_quat(scalar_first=True)
    return (
        gaussians,
        weights,
        centers,
        HandlePose(jnp.asarray(turns), jnp.asarray(rng.normal(size=(parts, 3)))),
    )


def rotated(gaussians):
    return np.asarray(matrices(gaussians.quats))


def by_handle(p, means, centers, pose):
    """The paper's formula for one handle, in numpy."""
    R = Rotation.from_quat(np.asarray(pose.quats[p]), scalar_first=True).as_matrix()
    return (means - centers[p]) @ R.T + centers[p] + pose.translations[p], R


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("blend", BLENDS)
class TestLaws:
    @given(seed=seeds)
    def test_one_handle_alone_is_a_rigid_motion(self, blend, seed):
        gaussians, _, centers, pose = made_up(seed, most=3.1)
        p = seed % 3
        moved = skinned(gaussians, np.eye(3)[np.full(7, p)], centers, pose, blend)
        means, R = by_handle(p, np.asarray(gaussians.means), centers, pose)
        np.testing.assert_allclose(moved.means, means, atol=1e-12)
        np.testing.assert_allclose(rotated(moved), R @ rotated(gaussians), atol=1e-9)

    @given(seed=seeds)
    def test_handles_that_move_as_one_need_no_weights(self, blend, seed):
        """The same rigid motion, expressed about three centres."""
        gaussians, weights, centers, pose = made_up(seed, most=3.1)
        quats, translations = np.asarray(pose.quats), np.asarray(pose.translations)
        R = Rotation.from_quat(quats[0], scalar_first=True).as_matrix()
        together = translations[0] + (centers - centers[0]) @ (R - np.eye(3)).T
        alike = HandlePose(jnp.asarray(np.tile(quats[0], (3, 1))), jnp.asarray(together))
        moved = skinned(gaussians, weights, centers, alike, blend)
        means, _ = by_handle(0, np.asarray(gaussians.means), centers, pose)
        np.testing.assert_allclose(moved.means, means, atol=1e-9)

    @given(seed=seeds)
    def test_signs_of_quaternions_and_the_order_of_handles_mean_nothing(self, blend, seed):
        gaussians, weights, centers, pose = made_up(seed)
        expected = skinned(gaussians, weights, centers, pose, blend)
        quats, translations = np.asarray(pose.quats), np.asarray(pose.translations)
        flipped = HandlePose(jnp.asarray(quats * [[-2.0], [1.0], [-0.5]]), pose.translations)
        order = np.random.default_rng(seed).permutation(3)
        shuffled = HandlePose(jnp.asarray(quats[order]), jnp.asarray(translations[order]))
        for moved in (
            skinned(gaussians, weights, centers, flipped, blend),
            skinned(gaussians, weights[:, order], centers[order], shuffled, blend),
        ):
            np.testing.assert_allclose(moved.means, expected.means, atol=1e-9)
            np.testing.assert_allclose(rotated(moved), rotated(expected), atol=1e-9)

    @pytest.mark.thorough
    @pytest.mark.parametrize("seed", range(3))
    def test_derivatives(self, blend, seed):
        gaussians, weights, centers, pose = made_up(seed, num=3, most=1.0)
        moved = partial(means_and_turns, gaussians, blend=blend)
        check_grads(moved, (weights, pose.quats, pose.translations, centers), order=1, modes=["fwd", "rev"])

    def test_a_batch_is_a_loop(self, blend):
        gaussians, weights, centers, _ = made_up(0)
        poses = [made_up(seed)[3] for seed in range(4)]
        many = jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *poses)
        batch = jax.vmap(lambda pose: skinned(gaussians, weights, centers, pose, blend))(many)
        batch = jax.device_get(batch)
        for i, pose in enumerate(poses):
            one = skinned(gaussians, weights, centers, pose, blend)
            np.testing.assert_allclose(batch.means[i], one.means, atol=1e-12)
            np.testing.assert_allclose(batch.quats[i], one.quats, atol=1e-12)

    @pytest.mark.thorough
    def test_handles_that_look_opposite_ways_give_numbers(self, blend):
        """180 degrees apart and with equal weights, no rotation between them is preferred."""
        gaussians, _, centers, pose = made_up(1)
        opposite = np.eye(4)[[0, 1, 3]]
        weights = np.tile([0.5, 0.5, 0.0], (7, 1))

        def total(quats):
            means, turned = means_and_turns(gaussians, weights, quats, pose.translations, centers, blend)
            return jnp.sum(means) + jnp.sum(turned)

        value, slope = jax.jit(jax.value_and_grad(total))(opposite)
        assert np.isfinite(value)
        assert np.isfinite(slope).all()


@pytest.mark.usefixtures("x64")
@given(seeds)
def test_polar_is_the_nearest_rotation(seed):
    gaussians, weights, centers, pose = made_up(seed, most=1.5)
    moved = skinned(gaussians, weights, centers, pose, "polar")
    sums = np.einsum("np,pij->nij", weights, matrices(pose.quats))
    nearest = np.array([polar(one)[0] for one in sums])
    np.testing.assert_allclose(rotated(moved), nearest @ rotated(gaussians), atol=1e-7)


@pytest.mark.usefixtures("x64")
@given(seeds, st.floats(0.0, 1.0))
def test_between_two_turns_about_one_axis_all_blends_turn_about_it(seed, share):
    """Dual quaternions keep distances to the axis; linear blends of points cut the corner."""
    rng = np.random.default_rng(seed)
    axis, angle = Rotation.random(rng=rng).apply([0.0, 0.0, 1.0]), rng.uniform(0.2, 2.5)
    point = axis * rng.normal()
    centers = np.stack([point, point])
    turned = Rotation.from_rotvec(angle * axis).as_quat(scalar_first=True)
    pose = HandlePose(
        jnp.asarray(np.stack([np.array([1.0, 0, 0, 0]), turned])), jnp.asarray(np.zeros((2, 3)))
    )
    gaussians = made_up(seed, num=4)[0]
    weights = np.tile([1 - share, share], (4, 1))
    vectors = [
        Rotation.from_matrix(
            rotated(skinned(gaussians, weights, centers, pose, blend))[0] @ rotated(gaussians)[0].T
        )
        for blend in BLENDS
    ]
    for one in vectors:
        np.testing.assert_allclose(np.cross(one.as_rotvec(), axis), 0, atol=1e-7)
        assert -1e-7 <= one.as_rotvec() @ axis <= angle + 1e-7

    def distance(means):
        return np.linalg.norm(np.cross(np.asarray(means), axis), axis=1)

    before = distance(gaussians.means)
    np.testing.assert_allclose(
        distance(skinned(gaussians, weights, centers, pose, "dual").means), before, atol=1e-9
    )
    assert (distance(jax.jit(skin_means)(gaussians.means, weights, centers, pose)) <= before + 1e-9).all()


def test_at_rest_nothing_moves_and_nothing_else_changes():
    gaussians, weights, centers, _ = made_up(3)

    @partial(jax.jit, static_argnums=2)
    def rest(weights, centers, blend):
        moved = skin(gaussians, weights, centers, at_rest(3), blend)
        assert moved.log_scales is gaussians.log_scales
        assert moved.sh0 is gaussians.sh0
        return moved.means, quats_to_matrices(moved.quats)

    for blend in BLENDS:
        means, turned = rest(weights, centers, blend)
        np.testing.assert_allclose(means, gaussians.means, atol=1e-6)
        np.testing.assert_allclose(turned, rotated(gaussians), atol=1e-6)


def test_a_handle_without_weight_changes_nothing_however_far_it_is():
    gaussians, weights, centers, pose = made_up(4)
    none = np.concatenate([weights[:, :2] / weights[:, :2].sum(1, keepdims=True), np.zeros((7, 1))], axis=1)
    translations = np.array(pose.translations)
    translations[2] = 1e6
    far = HandlePose(pose.quats, jnp.asarray(translations))
    for blend in BLENDS:
        np.testing.assert_allclose(
            skinned(gaussians, none, centers, far, blend).means,
            skinned(gaussians, none, centers, pose, blend).means,
            atol=1e-6,
        )


@pytest.mark.parametrize("blend", BLENDS)
def test_no_product_is_in_reduced_precision(blend):
    """The default is TF32 on GPUs that have it, which is off by half a millimetre per metre."""
    program = skinned.lower(*made_up(6), blend).as_text()
    assert "HIGHEST" in program
    assert "DEFAULT" not in program


def test_blended_quaternions_are_of_length_one():
    _, weights, _, pose = made_up(5, num=50)
    np.testing.assert_allclose(np.linalg.norm(blend_quats(weights, pose.quats), axis=1), 1, atol=1e-6)
