"""Straight-line paths to a grasp."""

import itertools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.methods.grasping import Grasp
from gsjax.methods.planning import straight_line

DOWN = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)  # z of the tool points down
logs = st.tuples(*[st.floats(-1.5, 1.5)] * 6)
plan = jax.jit(straight_line, static_argnames=("standoff", "lift", "steps"))


def at(x, y, z, pose=DOWN):
    pose = pose.copy()
    pose[:3, 3] = x, y, z
    return pose


def to(pose):
    return Grasp(jnp.asarray(pose), jnp.float32(0.05), jnp.float32(1.0), jnp.bool_(True))


def test_the_legs_are_before_the_grasp_at_it_closed_and_lifted():
    path = plan(at(0.3, 0.2, 0.5), to(at(0, 0, 0.1)), standoff=0.1, lift=0.15)
    ends = np.asarray(path.poses[9::10, :3, 3])
    np.testing.assert_allclose(ends, [[0, 0, 0.2], [0, 0, 0.1], [0, 0, 0.1], [0, 0, 0.25]], atol=1e-6)
    assert np.asarray(path.closed).tolist() == [False] * 20 + [True] * 20


def test_above_the_grasp_it_goes_straight_down():
    path = plan(at(0, 0, 0.13), to(at(0, 0, 0.1)))
    assert (np.diff(np.asarray(path.poses[:20, 2, 3])) <= 1e-6).all()
    np.testing.assert_allclose(path.poses[:20, :2, 3], 0, atol=1e-6)


def test_low_beside_the_grasp_it_rises_first():
    path = plan(at(0.2, 0, 0.1), to(at(0, 0, 0.1)), standoff=0.1)
    assert path.poses[9, 2, 3] > 0.19


@given(start=logs, goal=logs)
def test_all_poses_are_rigid_and_the_grasp_is_reached(start, goal):
    start, goal = (np.asarray(jaxlie.SE3.exp(jnp.asarray(v, jnp.float32)).as_matrix()) for v in (start, goal))
    path = plan(start, to(goal))
    rotations = np.asarray(path.poses[:, :3, :3])
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (40, 1, 1)), atol=1e-5
    )
    np.testing.assert_allclose(path.poses[19], goal, atol=1e-5)


@pytest.mark.thorough
@given(x=st.floats(-0.2, 0.2), z=st.floats(0.12, 0.6), step=st.integers(0, 17))
def test_the_plan_from_a_point_of_a_plan_is_its_rest(x, z, step):
    path = plan(at(x, 0, z), to(at(0, 0, 0.1)))
    again = plan(np.asarray(path.poses[step]), to(at(0, 0, 0.1)))
    rest = np.asarray(path.poses[step:20, :3, 3])
    for point in np.asarray(again.poses[:20, :3, 3]):  # on the same two lines
        assert distance(point, np.concatenate([rest[:1], rest])) < 2e-3


def distance(point, corners):
    """Distance from a point to the polyline through corners."""
    best = np.inf
    for a, b in itertools.pairwise(corners):
        share = np.clip((point - a) @ (b - a) / max((b - a) @ (b - a), 1e-12), 0, 1)
        best = min(best, np.linalg.norm(point - a - share * (b - a)))
    return best
