"""Detection of what moves, from many views, and the search for parts that jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.parts import BACKGROUND, DiscoverConfig, PartsConfig, begin, choose_anchor, moved_pixels
from gsjax.methods.parts.anchor import Anchor
from gsjax.methods.parts.discovery import initial_run
from gsjax.methods.parts.exposure import corrected, exposures_of
from gsjax.methods.parts.motion import assign_moving_strays, changes_of, changing_views, split_disconnected
from gsjax.methods.parts.search import groups_of, searched
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.frame import Frame, one_camera
from gsjax.scene.handles import HandlePose, at_rest
from gsjax.scene.render import plan_render, render
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear

FRAMES = 5


@pytest.fixture(scope="module")
def boxes():
    """A box that slides, and one that jumps by several times its width in each frame."""
    slides = Box(
        (-0.15, -0.05, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0)), linear(FRAMES, (0, 0.12, 0))
    )
    jumps = Box(
        (0.15, 0.25, 0.03), (0.06, 0.06, 0.06), linear(FRAMES, (0, 0, 0)), linear(FRAMES, (0, -0.5, 0))
    )
    return MovingBoxes([slides, jumps], cameras=5)


@pytest.fixture(scope="module")
def plan(boxes):
    return plan_render(boxes.gaussians, boxes.cameras, headroom=2.0)


@pytest.fixture(scope="module")
def moved(boxes):
    anchor = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    return moved_pixels(boxes.image, anchor, boxes.num_cameras)


@pytest.fixture(scope="module")
def changes(boxes, plan, moved):
    return changes_of(boxes.gaussians, boxes.cameras, plan, moved)


@pytest.mark.thorough
def test_what_leaves_changes_and_what_is_covered_for_a_while_does_not(boxes, changes):
    usual = changes.usual >= 0.5
    assert usual[boxes.bodies > 0].mean() > 0.8  # the sliding box still overlaps its first position
    assert usual[boxes.bodies == 0].mean() < 0.12
    assert (changes.most >= 0.5)[boxes.bodies == 0].mean() > 0.3
    assert (changes.most >= changes.usual).all()


def test_what_does_not_hang_together_is_not_one_part(boxes):
    moving = (boxes.bodies > 0).astype(int)  # two boxes as one part, by mistake
    weights = np.eye(4, dtype=np.float32)[moving] * 0.9 + 0.025
    divided = split_disconnected(weights, boxes.gaussians)
    np.testing.assert_allclose(divided.sum(-1), 1, rtol=1e-6)
    labels = divided.argmax(-1)
    assert ((labels == BACKGROUND) == (boxes.bodies == 0)).all()
    assert all(len(np.unique(labels[boxes.bodies == body])) == 1 for body in (1, 2))
    assert len(np.unique(labels)) == 3
    np.testing.assert_array_equal(split_disconnected(divided, boxes.gaussians), divided)
    full = weights[:, :2] / weights[:, :2].sum(-1, keepdims=True)
    np.testing.assert_array_equal(split_disconnected(full, boxes.gaussians), full)  # no slot is free
    few = np.flatnonzero(boxes.bodies == 2)[15:]
    weights[few] = np.eye(4)[BACKGROUND]
    assert split_disconnected(weights, boxes.gaussians)[boxes.bodies == 2].argmax(-1)[:15].max() == 1


@pytest.mark.thorough
def test_pixels_show_what_may_move(boxes, plan, changes):
    views = range(boxes.num_cameras)
    drawn = [render(boxes.gaussians, one_camera(boxes.cameras, c), plan) for c in views]
    shown = changing_views(boxes.gaussians, boxes.cameras, plan, changes, drawn)
    true = boxes.masks(boxes.bodies) > 0
    assert shown[true].mean() > 0.9
    covered = np.stack([np.asarray(view.alphas[0]) > 0.5 for view in drawn])
    assert shown[~true & covered].mean() < 0.5  # the boxes pass over some of it


def test_what_moves_joins_the_part_that_it_touches(boxes):
    """The masks cover half of the first box, and none of the second, which touches no part."""
    left = np.asarray(boxes.gaussians.means)[:, 1] < boxes.boxes[0].center[1]
    known = (boxes.bodies == 1) & left
    weights = np.eye(4, dtype=np.float32)[np.where(known, 1, 0)]
    found = assign_moving_strays(weights, boxes.gaussians, boxes.bodies > 0)
    np.testing.assert_allclose(found.sum(-1), 1, rtol=1e-6)
    labels = found.argmax(-1)
    assert set(labels[boxes.bodies == 1]) == {1}
    assert set(labels[boxes.bodies != 1]) == {BACKGROUND}


def test_what_came_before_something_did_not_move_it():
    """With depth, what a moving object comes to cover does not count as changed."""
    pictures, depths = np.full((2, 12, 16, 3), 100, np.uint8), np.full((2, 12, 16), 2.0, np.float32)
    pictures[0, 4:8, 2:6], depths[0, 4:8, 2:6] = 250, 1.5
    pictures[1, 4:8, 10:14], depths[1, 4:8, 10:14] = 250, 1.5
    anchor = Anchor(0, 1, np.array([0.0, 0.1]))
    both = moved_pixels(lambda t, c: pictures[t], anchor, 1)[0, 0]
    left = moved_pixels(lambda t, c: pictures[t], anchor, 1, depth=lambda t, c: depths[t])[0, 0]
    before, after = (slice(5, 7), slice(3, 5)), (slice(5, 7), slice(11, 13))
    assert both[before].all()
    assert both[after].all()
    assert left[before].all()
    assert not left[after].any()


GRAIN = np.random.default_rng(0).integers(60, 200, (2, 40, 60, 1)) * np.array([1.0, 0.9, 0.8])
SHADOW = slice(16, 25), slice(21, 35)  # without the border, where shadows are not detected


@pytest.mark.parametrize(
    ("now", "farther", "moves"),
    [
        (0.5 * GRAIN[0], 0.0, False),
        (0.5 * GRAIN[0], 0.1, True),  # another surface, farther away
        (GRAIN[1], 0.0, True),  # of the same hue and at the same depth
        (0.5 * GRAIN[0, ..., ::-1], 0.0, True),  # of another hue
    ],
)
def test_a_shadow_that_moves_is_no_motion(now, farther, moves):
    """Regression test: on a granite table, the shadow of a lid was followed as a part."""
    noise = np.random.default_rng(1).normal(1, 0.002, (2, 40, 60))
    depths = (2 * noise).astype(np.float32)
    depths[1, 10:30, 15:40] += farther
    pictures = np.stack([GRAIN[0], GRAIN[0]]).astype(np.uint8)
    pictures[1, 10:30, 15:40] = now[10:30, 15:40]
    pictures[0, 33:39, :6], pictures[1, 33:39, :6] = (200, 40, 40), (40, 40, 200)  # something moves
    by_colors = changed_pixels(pictures, None)[SHADOW].mean()
    by_depth = changed_pixels(pictures, depths)[SHADOW].mean()
    assert by_colors > 0.25
    assert by_depth > 0.7 * by_colors if moves else by_depth < 0.1


def test_a_plain_plate_that_slides_is_seen_to_move():
    """It has no texture that would distinguish it from a shadow."""
    pictures, depths = np.full((2, 40, 60, 3), 80, np.uint8), np.full((2, 40, 60), 2.0, np.float32)
    pictures[0, 10:30, 5:25] = pictures[1, 10:30, 30:50] = 200
    changed = changed_pixels(pictures, depths)
    assert changed[12:28, 9:21].all()
    assert not changed[:8].any()
    assert not changed[:, 52:].any()


def changed_pixels(pictures, depths):
    """The changed pixels of the first of two pictures from one camera."""
    anchor = Anchor(0, 1, np.array([0.0, 1.0]))
    depth = None if depths is None else lambda t, c: depths[t]
    return moved_pixels(lambda t, c: pictures[t], anchor, 1, frames=1, depth=depth)[0, 0]


@pytest.fixture(scope="module")
def start(boxes, moved):
    config = PartsConfig(grid=FeatureGridConfig(4, 4, 32, 12, 2, 16))
    anchor = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    masks = boxes.masks(boxes.bodies)
    return begin(boxes, boxes.gaussians, anchor, moved, config, None, jax.random.key(0), masks)


@pytest.mark.thorough
def test_parts_that_touch_are_one_group(boxes, start):
    discovery = initial_run(start, FRAMES, PartsConfig()).kept
    weights = np.asarray(discovery.weights)
    assert [group.parts.tolist() for group in groups_of(discovery)] == [[1], [2]]
    labels = weights.argmax(-1)
    half = np.asarray(start.canonical.movable.means)[:, 1] < boxes.boxes[0].center[1]
    weights = np.eye(weights.shape[1], dtype=np.float32)[np.where((labels == 1) & half, 3, labels)]
    discovery = discovery._replace(weights=jnp.asarray(weights))
    assert [group.parts.tolist() for group in groups_of(discovery)] == [[1, 3], [2]]


@pytest.mark.thorough
@pytest.mark.parametrize("t", [1, 4])
def test_what_jumped_is_found(boxes, start, t):
    shifts = [box.shifts[t] for box in boxes.boxes]
    rest = at_rest(len(start.canonical.alive))
    predicted = np.array([shifts[0], boxes.boxes[1].shifts[t - 1]], np.float32)
    pose = HandlePose(rest.quats, rest.translations.at[1:3].set(predicted))
    discovery = initial_run(start, FRAMES, PartsConfig()).kept._replace(predicted=pose)
    found = searched(discovery, boxes.frame(t), boxes.frame(0), "quaternion")
    assert np.linalg.norm(found.translations[2] - shifts[1]) < 0.025  # of 0.125 m
    np.testing.assert_array_equal(found.translations[1], pose.translations[1])


@pytest.mark.thorough
def test_what_lands_in_front_of_something_is_found_by_the_other_cameras(boxes, start):
    t, shifts, rest = 2, boxes.boxes[1].shifts, at_rest(len(start.canonical.alive))
    predicted = np.array([boxes.boxes[0].shifts[t], shifts[t - 1]], np.float32)
    pose = HandlePose(rest.quats, rest.translations.at[1:3].set(predicted))
    discovery = initial_run(start, FRAMES, PartsConfig()).kept._replace(predicted=pose)
    now, before = boxes.frame(t), np.asarray(boxes.frame(0).images)
    images = np.array(now.images)
    images[0][np.abs(images[0] - before[0]).max(-1) > 0.05] = 0.5  # in one camera something else is there
    hidden = Frame(jnp.asarray(images), now.depths, now.cameras)
    found = searched(discovery, hidden, boxes.frame(0), "quaternion")
    assert np.linalg.norm(found.translations[2] - shifts[t]) < 0.025  # of 0.125 m


@pytest.mark.thorough
def test_what_is_where_it_should_be_stays_to_the_bit(boxes, start):
    discovery, here = initial_run(start, FRAMES, PartsConfig()).kept, boxes.frame(0)
    assert searched(discovery, here, here, "quaternion") is discovery.predicted
    empty = np.zeros_like(discovery.weights)
    empty[:, BACKGROUND] = 1
    nothing = discovery._replace(weights=jnp.asarray(empty))
    assert searched(nothing, here, here, "quaternion") is discovery.predicted


def test_the_exposure_of_each_camera_is_found_whatever_stands_before_it(boxes, plan):
    """Cameras differ in gain and tint; the fourth also sees something that is not in the scene."""
    drawn = [render(boxes.gaussians, one_camera(boxes.cameras, c), plan) for c in range(5)]
    rng = np.random.default_rng(0)
    maps = np.eye(3, 4) + rng.uniform(-0.05, 0.05, (5, 3, 4))
    maps += np.eye(3, 4) - maps.mean(0)
    colors = np.concatenate([np.asarray(view.colors) for view in drawn])
    exposed = np.einsum("cij,chwj->chwi", np.linalg.inv(maps[..., :3]), colors - maps[:, None, None, :, 3])
    strange = exposed.copy()
    strange[3, 20:28, 28:36] = [1.0, 0.0, 1.0]
    frames = [Frame(jnp.asarray(images, jnp.float32), None, boxes.cameras) for images in (exposed, strange)]
    for frame in frames:
        found = exposures_of(drawn, frame)
        np.testing.assert_allclose(found.mean(0), np.eye(3, 4), atol=1e-6)
        shown = np.concatenate([np.asarray(view.alphas) for view in drawn]) > 0.5
        off = np.abs(np.asarray(corrected(frame, found).images) - np.clip(colors, 0, 1)).max(-1)
        assert np.median(off[shown]) < 0.01
    without = np.abs(np.clip(exposed, 0, 1) - np.clip(colors, 0, 1)).max(-1)
    assert np.median(without[shown]) > 0.03


@pytest.mark.thorough
def test_exposures_may_be_left_as_they_are(boxes, moved):
    config = PartsConfig(discover=DiscoverConfig(lift_iterations=1), exposures=False)
    anchor = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    masks = boxes.masks(boxes.bodies)
    key = jax.random.key(0)
    start = begin(boxes, boxes.gaussians, anchor, moved, config, None, key, masks)
    assert (start.exposures == np.eye(3, 4)).all()
    assert (
        begin(boxes, boxes.gaussians, anchor, moved, PartsConfig(), None, key, masks).exposures
        != start.exposures
    ).any()
