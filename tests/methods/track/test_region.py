"""Gaussians left out of the refinement do not change its pixels; capacities grow in common rungs."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.track import first_pose, place
from gsjax.methods.track.plan import Needed, TrackPlan
from gsjax.methods.track.region import near_background, near_scene, scatter, shift_background
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import plan_render, render


@pytest.mark.thorough
def test_the_near_scene_draws_the_region_as_the_whole_scene_does(table, started):
    _, frames, _ = table()
    pose, cameras = first_pose(started), frames[0].cameras
    plan = plan_render(started.gaussians, cameras)
    member = np.asarray(started.labels[: started.num_moving]) == started.num_objects  # the last object alone
    tiles = touched_tiles([pose.means[member]], frames[0])
    roi = tiles_to_pixels(tiles, frames[0])
    whole = render(started.gaussians, cameras, plan)
    near = near_background(started, whole, tiles)
    assert 0 < int(near.sum()) < near.shape[0]
    around = near_scene(started, near, int(near.sum()) + 7)
    part = render(place(around, pose), cameras, plan, roi=roi)
    np.testing.assert_allclose(np.where(roi, part.alphas, 0), np.where(roi, whole.alphas, 0), atol=1e-6)
    gap = np.where(roi[..., None], part.colors - whole.colors, 0)
    np.testing.assert_allclose(gap, 0, atol=1e-6)


def test_touched_tiles_hold_the_points_and_their_neighbours(table):
    _, frames, _ = table()
    tiles = touched_tiles([jnp.array([[-0.03, 0.0, 0.04]])], frames[0])  # the point that all cameras look at
    assert tiles.shape == (2, 5, 6)
    np.testing.assert_array_equal(tiles.sum((1, 2)), 9)
    assert tiles[:, 2, 3].all()
    assert tiles_to_pixels(tiles, frames[0]).shape == (2, 72, 96)
    behind = jnp.array([[5.0, 0.0, 4.0]])
    assert not touched_tiles([behind], frames[0]).any()


def test_a_plan_grows_to_the_lowest_rungs_that_hold_what_was_needed():
    plan = TrackPlan(Plan(96, 72, rung(1)), Plan(96, 72, rung(5000)), rung(1))
    needed = Needed(jnp.array(7000), jnp.array(100), jnp.array(9000))
    assert needed.exceeds(plan)
    grown = plan.grown(needed, 1.5)
    assert grown == TrackPlan(Plan(96, 72, rung(10500)), Plan(96, 72, rung(5000)), rung(13500))
    assert not needed.exceeds(grown)
    assert grown.grown(needed, 1.5) == grown
    assert hash(grown) == hash(grown.grown(needed, 1.0))


@pytest.mark.thorough
def test_what_belongs_to_the_near_scene_is_given_back_to_the_whole(started):
    num = started.gaussians.num - started.num_moving
    near = jnp.arange(num) % 3 == 1
    around = near_scene(started, near, int(near.sum()) + 7)
    shifts = jnp.arange(3.0 * (around.gaussians.num - around.num_moving)).reshape(-1, 3)
    moved = shift_background(started, scatter(near, shifts)).gaussians.means - started.gaussians.means
    moved_near = shift_background(around, shifts).gaussians.means - around.gaussians.means
    rows = started.num_moving + np.flatnonzero(near)
    np.testing.assert_allclose(moved[rows], moved_near[around.num_moving : -7], rtol=1e-4)
    assert not np.delete(np.asarray(moved), rows, axis=0).any()
