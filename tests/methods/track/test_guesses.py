"""Guesses of the pose of a lost object: near the last guess, and rotated about the middle of the object."""

from dataclasses import replace

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from gsjax.methods.track import PRESETS
from gsjax.methods.track.align import ball_grid
from gsjax.methods.track.recover import guesses_near, guesses_spun, solid_center
from gsjax.methods.track.reference import ReferencePoints


def test_guesses_near_the_last_one_stay_near():
    config, guess = PRESETS["accurate"].align, np.float32([0.3, 0.0, 0.1, 0.0, 0.5, 0.0])
    shifts = np.float32(ball_grid(config.reach, config.spacing))
    shifts = np.concatenate([shifts, 0 * shifts], axis=1)
    draw = jax.jit(guesses_near, static_argnums=3)
    drawn = np.asarray(draw(jax.random.key(0), shifts, guess, config))
    np.testing.assert_allclose(drawn[:, :3], guess[:3] + shifts[:, :3] / 2, atol=1e-6)
    turns = (Rotation.from_rotvec(drawn[:, 3:]) * Rotation.from_rotvec(guess[3:]).inv()).magnitude()
    assert 0.1 < np.median(turns) < 0.8
    unturned = np.asarray(draw(jax.random.key(0), shifts, guess, replace(config, max_turn=0.0)))
    np.testing.assert_allclose(unturned[:, 3:], np.broadcast_to(guess[3:], unturned[:, 3:].shape), atol=1e-6)


def can_shell(seed=0, count=64):
    """(points and outward normals of the top and of half of the wall of a can, the middle of the can): radius
    34 mm, height 110 mm."""
    rng = np.random.default_rng(seed)
    angle, height = rng.uniform(-1.6, 1.6, count), rng.uniform(-0.055, 0.055, count)
    around = np.stack([np.cos(angle), np.sin(angle), 0 * angle])
    on_top = np.arange(count) % 4 == 0
    radius = np.where(on_top, 0.034 * np.sqrt(rng.uniform(size=count)), 0.034)
    means = around * radius + np.stack([0 * angle, 0 * angle, np.where(on_top, 0.055, height)])
    normals = np.where(on_top, np.array([[0.0], [0.0], [1.0]]), around)
    middle = np.float32([0.3, -0.2, 0.1])
    given = np.float32(means) + middle[:, None], np.float32(normals), np.zeros((3, count), np.float32)
    return ReferencePoints(*given, np.ones(count, bool)), middle


def test_the_middle_of_a_solid_is_behind_the_sides_that_are_known():
    find = jax.jit(solid_center)
    reference, middle = can_shell()
    np.testing.assert_allclose(find(reference)[:2], middle[:2], atol=6e-3)
    assert np.linalg.norm(reference.means.mean(1)[:2] - middle[:2]) > 0.015
    padded = reference._replace(real=np.arange(64) < 40, means=reference.means.copy())
    before = np.asarray(find(padded))
    padded.means[:, 40:] = 9.0
    np.testing.assert_allclose(find(padded), before, atol=1e-6)
    without = reference._replace(normals=0 * reference.normals)
    np.testing.assert_allclose(find(without), reference.means.mean(1), atol=1e-6)
    rng = np.random.default_rng(0)
    normals = np.repeat(np.eye(3, dtype=np.float32), 20, axis=1)  # three sides of a cube
    sides = np.where(normals > 0, np.float32(0.05), np.float32(rng.uniform(-0.05, 0.05, (3, 60))))
    cube = ReferencePoints(sides, normals, sides, np.ones(60, bool))
    assert np.linalg.norm(find(cube)) < 0.005 < np.linalg.norm(sides.mean(1))


def test_guesses_that_spin_keep_the_middle_and_turn_by_any_angle_either_way_up():
    reference, _ = can_shell()
    config, guess = PRESETS["accurate"].align, np.float32([0.1, 0.0, 0.05, 0.0, 0.5, 0.0])
    center = reference.means.mean(1)
    draw = jax.jit(guesses_spun, static_argnums=(1, 6))
    drawn = np.asarray(draw(jax.random.key(0), 120, np.eye(3), reference, center, guess, config))
    middle = np.asarray(jax.jit(solid_center)(reference))

    def place(twists):
        return Rotation.from_rotvec(twists[:, 3:]).apply(middle - center) + center + twists[:, :3]

    np.testing.assert_allclose(place(drawn), np.repeat(place(guess[None]), 120, axis=0), atol=1e-5)
    up = (Rotation.from_rotvec(guess[3:]).inv() * Rotation.from_rotvec(drawn[:, 3:])).as_matrix()[:, 2, 2]
    assert (up > 0.999).sum() > 10  # spun about its axis, either way up
    assert (up < -0.999).sum() > 10
    still = draw(jax.random.key(0), 12, np.eye(3), reference, center, guess, replace(config, max_turn=0.0))
    np.testing.assert_allclose(still, np.repeat(guess[None], 12, axis=0), atol=1e-6)
