"""Captured motions are within the limits; how far an edit exceeds them is reported in metres and radians."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.geometry.joints import Joint
from gsjax.methods.parts import edits
from gsjax.methods.parts.film import Layer
from gsjax.methods.parts.limits import Beyond, beyond_captured, describe_beyond
from tests.methods.parts.made_up_parts import STEP, jointed, scene_of, trajectory

TIMES = STEP * np.arange(9.0)
DRAWER = Joint("prismatic", np.array([0.6, 0.8, 0.0]), np.zeros(3), 0.4 * np.sin(2.5 * TIMES))
DOOR = Joint("revolute", np.array([0.0, 0.0, 1.0]), np.array([0.5, 0.0, 0.0]), 1.2 * TIMES**2)
STILL = Joint("prismatic", np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(9))

how_far = jax.jit(beyond_captured)


def kitchen():
    scene = scene_of(0, num=40)
    return Layer(scene, jointed([STILL, DRAWER, DOOR], np.asarray(scene.centers), TIMES))


@jax.jit
def retimed(trajectory):
    edited = edits.speed(trajectory, [1], -0.37, 0.1, 0.8)
    edited = edits.loop(edited, [2], 0.13, 0.41, bounce=True)
    return edits.scale(edits.fade(edits.freeze(edited, [3], at=0.3), [1, 3], 0.2), [2], 4.0)


@pytest.mark.thorough
@given(st.integers(0, 10_000))
def test_edits_of_time_stay_within_the_limits(seed):
    """Also between the moments that were captured."""
    captured = Layer(scene_of(seed, parts=4), trajectory(seed))
    beyond = how_far(captured, retimed(captured.trajectory))
    np.testing.assert_allclose(beyond.metres, 0, atol=2e-5)
    np.testing.assert_allclose(beyond.radians, 0, atol=2e-4)


def test_a_drawer_that_is_pulled_further_is_so_far_beyond():
    captured = kitchen()
    edited = edits.amplify(captured.trajectory, [1], 1.5)
    values = 1.5 * DRAWER.values
    expected = np.maximum(values - DRAWER.values.max(), 0)
    beyond = how_far(captured, edited)
    np.testing.assert_allclose(np.asarray(beyond.metres)[:, 1], expected, atol=1e-5)
    np.testing.assert_allclose(beyond.radians, 0, atol=1e-4)
    np.testing.assert_array_equal(np.asarray(beyond.metres)[:, [0, 2]].max() < 1e-5, True)


def test_a_door_that_is_opened_further_is_so_far_beyond_and_a_drawer_to_the_side_too():
    captured = kitchen()
    arm = jnp.asarray(DOOR.point - np.asarray(captured.scene.centers[2]))
    edited = edits.rotate(captured.trajectory, [2], jnp.array([0.0, 0.0, 0.4]), arm)
    edited = edits.move(edited, [1], jnp.array([0.0, 0.0, 0.07]))
    beyond = how_far(captured, edited)
    expected = np.maximum(DOOR.values + 0.4 - DOOR.values.max(), 0)
    np.testing.assert_allclose(np.asarray(beyond.radians)[:, 2], expected, atol=1e-3)
    np.testing.assert_allclose(np.asarray(beyond.metres)[:, 1], 0.07, atol=1e-5)


def test_one_captured_moment_is_all_there_is():
    captured = Layer(scene_of(1, parts=4), trajectory(1, moments=1))
    moved = edits.move(captured.trajectory, [2], jnp.array([0.3, 0.0, 0.4]))
    np.testing.assert_allclose(how_far(captured, moved).metres, [[0, 0, 0.5, 0]], atol=1e-6)


def test_what_is_only_moved_is_not_said_to_be_turned():
    """Captured poses of the opened door are slightly nearer to the moved one, but only by a rotation."""
    captured = kitchen()
    moved = edits.move(captured.trajectory, [2], jnp.array([0.3, 0.1, 0.0]))
    beyond = how_far(captured, moved)
    np.testing.assert_allclose(np.asarray(beyond.metres)[:, 2], np.hypot(0.3, 0.1), rtol=0.02)
    (said,) = describe_beyond(beyond, captured.trajectory.times, {"door": 2}, least_rad=0.1)
    assert "degrees" not in said


@pytest.mark.parametrize("named", [True, False])
def test_it_is_said_of_each_part_how_far_and_when(named):
    metres = np.zeros((10, 3))
    metres[4:7, 1] = [0.01, 0.041, 0.02]
    radians = np.zeros((10, 3))
    radians[5, 1] = np.deg2rad(2.5)
    radians[:, 2] = 0.01
    beyond, times = Beyond(jnp.asarray(metres), jnp.asarray(radians)), jnp.arange(10.0) / 10
    (said,) = describe_beyond(beyond, times, {"drawer": 1} if named else {})
    name = "drawer" if named else "part 1"
    assert said.startswith(f"{name} goes up to 41 mm and 2.5 degrees beyond what was captured, ")
    assert "at 3 of 10 moments from 0.40 s to 0.60 s" in said
    assert describe_beyond(beyond, times, {}, least_m=0.05, least_rad=0.1) == []
