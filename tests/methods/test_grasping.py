"""Antipodal grasps: known shapes, invariances, and what must not be grasped."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gsjax.methods.grasping import Gripper, best_grasp, sample_poses, score_grasp

PANDA = Gripper()
NOTHING = jnp.zeros((40, 3)), jnp.zeros(40, bool)
KEY = jax.random.key(0)
grasp_jit = jax.jit(best_grasp, static_argnames=("gripper", "samples", "max_angle", "unseen"))
score_jit = jax.jit(score_grasp, static_argnames="gripper")
pose_jit = jax.jit(lambda log: jaxlie.SE3.exp(log).as_matrix())
sample_jit = jax.jit(sample_poses, static_argnames=("gripper", "samples"))


def box(size, count=1200, seed=0, faces=range(6)):
    """Points on faces of a box about the origin, and their normals; faces are -x, -y, -z, +x, +y, +z."""
    rng, size = np.random.default_rng(seed), np.asarray(size, np.float32)
    face = rng.choice(list(faces), count)
    axis, sign = face % 3, np.where(face < 3, -1.0, 1.0)
    points = rng.uniform(-0.5, 0.5, (count, 3)) * size
    points[np.arange(count), axis] = sign * size[axis] / 2
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = sign
    return points.astype(np.float32), normals.astype(np.float32)


def cylinder(radius, height, count=1200, seed=0):
    """Points on the side of an upright cylinder about the origin, and their normals."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, count)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    points = radius * normals + np.stack([0 * angle, 0 * angle, rng.uniform(-0.5, 0.5, count) * height], 1)
    return points.astype(np.float32), normals.astype(np.float32)


def sphere(radius, count=1200, seed=0):
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (radius * normals).astype(np.float32), normals.astype(np.float32)


def grasp(cloud, obstacles=NOTHING, samples=512, key=KEY, **options):
    points, normals = cloud
    valid = np.ones(len(points), bool)
    return grasp_jit(key, points, normals, valid, *obstacles, PANDA, samples, **options)


@pytest.mark.thorough
def test_a_box_is_grasped_across_its_only_narrow_side():
    found = grasp(box((0.20, 0.05, 0.15)))
    assert found.feasible
    assert found.score > 0.98
    np.testing.assert_allclose(found.width, 0.05, atol=0.004)
    pose = np.asarray(found.pose)
    assert abs(pose[1, 1]) > 0.98  # the fingers close along y
    assert abs(pose[1, 3]) < 0.003  # midway


def test_a_cylinder_is_grasped_through_its_axis():
    found = grasp(cylinder(0.03, 0.12))
    assert found.feasible
    assert found.score > 0.95
    np.testing.assert_allclose(found.width, 0.06, atol=0.004)
    (x, y), (along_x, along_y) = np.asarray(found.pose)[:2, [3, 1]].T
    assert abs(x * along_y - y * along_x) < 0.006


def test_a_sphere_is_grasped_through_its_center():
    found = grasp(sphere(0.03))
    assert found.feasible
    assert found.score > 0.95
    np.testing.assert_allclose(found.width, 0.06, atol=0.004)
    pose = np.asarray(found.pose)
    beside = pose[:3, 3] @ pose[:3, :2]
    assert np.linalg.norm(beside) < 0.008


@pytest.mark.parametrize("cloud", [box((0.12, 0.12, 0.12)), cylinder(0.06, 0.15), sphere(0.065)])
def test_what_is_wider_than_the_gripper_has_no_feasible_grasp(cloud):
    assert not grasp(cloud).feasible


@pytest.mark.thorough
def test_nothing_at_all_has_no_grasp_and_no_nan():
    found = grasp_jit(KEY, np.zeros((5, 3)), np.zeros((5, 3)), np.zeros(5, bool), *NOTHING, PANDA, 8)
    assert not found.feasible
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


@pytest.mark.thorough
def test_approaches_stay_within_the_angle():
    down = np.array([0.0, 0.0, -1.0], np.float32)
    for seed in range(5):
        found = grasp(cylinder(0.03, 0.12), key=jax.random.key(seed), approach=down, max_angle=0.3)
        assert found.feasible
        assert np.asarray(found.pose)[2, 2] <= -np.cos(0.3)


@pytest.mark.thorough
def test_a_table_below_is_not_hit_and_a_wall_forbids_the_side_grasp():
    cloud = cylinder(0.03, 0.12)
    rng = np.random.default_rng(1)
    table = np.concatenate([rng.uniform(-0.2, 0.2, (4000, 2)), np.full((4000, 1), -0.06)], 1).astype(
        np.float32
    )
    found = grasp(cloud, (table, np.ones(len(table), bool)))
    assert found.feasible
    inside = swept(found, table)
    assert not inside.any()
    tube = cylinder(0.045, 0.5, 4000)[0]  # all around, with less clearance than the thickness of a finger
    assert not grasp(cloud, (tube, np.ones(len(tube), bool))).feasible


def swept(found, points):
    """Whether each point is in the boxes that the fingers sweep on their way to the contacts; in NumPy."""
    pose = np.asarray(found.pose)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    x, y, z = np.abs(local[:, 0]), np.abs(local[:, 1]), local[:, 2]
    inner, outer = float(found.width) / 2, PANDA.max_width / 2 + PANDA.finger_thickness
    along = (z > PANDA.tip - PANDA.finger_height + 1e-6) & (z < PANDA.tip - 1e-6)
    return (x < PANDA.finger_depth / 2 - 1e-6) & (y > inner + 1e-6) & (y < outer - 1e-6) & along


@pytest.mark.thorough
@given(seed=st.integers(0, 1000), size=st.tuples(*[st.floats(0.02, 0.12)] * 3))
def test_feasible_means_that_it_fits_and_hits_nothing(seed, size):
    obstacles = np.random.default_rng(seed).uniform(-0.15, 0.15, (40, 3)).astype(np.float32)
    found = grasp(box(size, seed=seed), (obstacles, np.ones(40, bool)), 64, jax.random.key(seed))
    assume(found.feasible)
    assert found.width <= PANDA.max_width
    assert not swept(found, obstacles).any()
    rotation = np.asarray(found.pose)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(rotation) > 0


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@given(seed=st.integers(0, 1000), log=st.tuples(*[st.floats(-2, 2)] * 6))
def test_what_moves_rigidly_is_grasped_alike(seed, log):
    points, normals = (a.astype(np.float64) for a in box((0.05, 0.07, 0.1), 400, seed))
    obstacles = np.random.default_rng(seed).uniform(-0.2, 0.2, (30, 3))
    motion = np.asarray(pose_jit(np.array(log)))
    turned, *moved = (a @ motion[:3, :3].T for a in (normals, points, obstacles))
    moved = [a + motion[:3, 3] for a in moved]
    ones = np.ones(400, bool), np.ones(30, bool)
    here = grasp_jit(KEY, points, normals, ones[0], obstacles, ones[1], PANDA, 64)
    there = grasp_jit(KEY, moved[0], turned, ones[0], moved[1], ones[1], PANDA, 64)
    np.testing.assert_allclose(there.score, here.score, atol=1e-9)
    np.testing.assert_allclose(there.width, here.width, atol=1e-9)
    assert there.feasible == here.feasible
    np.testing.assert_allclose(there.pose, motion @ np.asarray(here.pose), atol=1e-8)


@given(seed=st.integers(0, 1000))
def test_a_feasible_grasp_scored_again_is_itself(seed):
    points, normals = box((0.05, 0.07, 0.1), seed=seed)
    valid = np.ones(len(points), bool)
    found = grasp((points, normals), samples=64, key=jax.random.key(seed))
    again = score_jit(found.pose, points, normals, valid, *NOTHING, PANDA)
    assume(found.feasible)
    assert again.feasible
    np.testing.assert_allclose(again.score, found.score, atol=1e-3)
    np.testing.assert_allclose(again.pose, found.pose, atol=1e-5)


@pytest.mark.thorough
def test_rows_that_are_not_finite_or_not_valid_change_nothing():
    points, normals = cylinder(0.03, 0.12, 500)
    bad = np.full((3, 3), np.nan, np.float32)
    bad[1] = np.inf
    worse = np.concatenate([points, bad, points + 0.01]), np.concatenate([normals, bad, normals])
    valid = np.arange(1003) < 503
    obstacles = np.concatenate([bad, np.zeros((2, 3), np.float32)])
    plain = grasp_jit(KEY, points, normals, np.ones(500, bool), *NOTHING, PANDA, 128)
    found = grasp_jit(KEY, *worse, valid, obstacles, np.arange(5) < 3, PANDA, 128)
    for a, b in zip(plain, found, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_normal_that_is_not_finite_leaves_the_point_its_extent():
    points, normals = box((0.12, 0.05, 0.12))
    unknown = np.where((np.abs(points[:, 1:2]) < 0.024), np.nan, normals)  # only the two sides have normals
    found = grasp((points, unknown))
    assert found.feasible
    assert abs(np.asarray(found.pose)[1, 1]) > 0.98


def test_a_far_side_that_nobody_saw_counts_half_and_loses_to_one_that_was_seen():
    shell = box((0.04, 0.05, 0.12), faces=(0, 2, 5, 3, 1))  # +y is missing
    found = grasp(shell)
    assert abs(np.asarray(found.pose)[0, 1]) > 0.95  # along x, where both sides are seen
    assert found.score > 0.95
    thin = box((0.12, 0.05, 0.12), faces=(0, 2, 5, 3, 1))  # too wide along x
    found = grasp(thin, unseen=0.5)
    assert found.feasible
    assert 0.45 < found.score <= 0.5
    assert not grasp(thin, unseen=0.0).feasible


def test_frames_may_be_mapped_over():
    clouds = [cylinder(0.02 + 0.005 * i, 0.1, 300, i) for i in range(3)]
    points, normals = (np.stack(arrays) for arrays in zip(*clouds, strict=True))
    keys = jax.random.split(KEY, 3)

    @jax.jit
    def one(key, points, normals):
        return best_grasp(key, points, normals, jnp.ones(300, bool), *NOTHING, PANDA, 64)

    mapped = jax.device_get(jax.jit(jax.vmap(one))(keys, points, normals))
    for i in range(3):
        for a, b in zip(mapped, one(keys[i], points[i], normals[i]), strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-5)


def test_samples_ride_with_the_points_they_were_drawn_from():
    points, normals = cylinder(0.03, 0.12, 300)
    valid = np.ones(300, bool)
    here = np.asarray(sample_jit(KEY, points, normals, valid, PANDA, 32))
    there = np.asarray(sample_jit(KEY, points + np.float32([1, 2, 3]), normals, valid, PANDA, 32))
    drawn = np.isfinite(here).all(axis=(1, 2))
    assert drawn.sum() > 28
    np.testing.assert_allclose((there - here)[drawn, :3, 3], np.tile([1, 2, 3], (drawn.sum(), 1)), atol=1e-5)


@pytest.mark.parametrize(("name", "value"), [("max_width", 0.0), ("tip", -1.0), ("palm_depth", float("nan"))])
def test_a_gripper_without_a_size_is_refused(name, value):
    with pytest.raises(ValueError, match=f"Gripper.{name}: expected more than 0, found"):
        Gripper(**{name: value})


def test_no_samples_are_refused():
    with pytest.raises(ValueError, match="samples: expected 1 or more, found 0"):
        grasp(cylinder(0.03, 0.1, 10), samples=0)
