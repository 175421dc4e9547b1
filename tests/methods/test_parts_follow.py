"""Whole discoveries on boxes of which all is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.parts import (
    BACKGROUND,
    DiscoverConfig,
    PartsConfig,
    StreamConfig,
    UnifyConfig,
    begin,
    choose_anchor,
    first_parts,
    follow,
    gaussians_at,
    moment,
    moved_pixels,
    outcome,
    without_needless,
)
from gsjax.methods.parts.finish import given, settled, touching
from gsjax.methods.parts.follow import joined, order_of_frames
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.handles import skin
from tests.methods.moving_boxes import Box, MovingBoxes, linear

FRAMES = 5
CONFIG = PartsConfig(
    discover=DiscoverConfig(most_parts=4, lift_iterations=9),
    stream=StreamConfig(iterations=30, coarse=0.0),
    unify=UnifyConfig(every=2, noise=0.7),
    grid=FeatureGridConfig(4, 4, 32, 12, 2, 16),
)


@pytest.fixture(scope="module")
def boxes():
    first = Box(
        (-0.12, 0, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0.4)), linear(FRAMES, (0, 0.08, 0))
    )
    second = Box(
        (0.14, -0.02, 0.04), (0.08, 0.1, 0.08), linear(FRAMES, (0, 0, 0)), linear(FRAMES, (0.0, -0.08, 0))
    )
    return MovingBoxes([first, second])


def discovered(views, pieces, config=CONFIG, anchor=0):
    found = choose_anchor(views.image, views.num_frames, views.num_cameras, anchor)
    moved = moved_pixels(views.image, found, views.num_cameras)
    start = begin(views, views.gaussians, found, moved, config, None, jax.random.key(0), views.masks(pieces))
    return start, list(follow(views, start, first_parts(start, views.num_frames, config), config))


def bodies_of(views, start):
    return views.bodies[start.order[: start.canonical.movable.num]]


def errors_mm(views, start, parts, t):
    """Of the Gaussians of each box, in the median."""
    moved = skin(parts.canonical.movable, parts.weights, parts.canonical.centers, parts.pose(t)).means
    true = np.asarray(views.at(t).means)[start.order[: len(moved)]]
    off = 1000 * np.linalg.norm(np.asarray(moved) - true, axis=1)
    bodies = bodies_of(views, start)
    return [float(np.median(off[bodies == k])) for k in range(1, len(views.boxes) + 1)]


@pytest.fixture(scope="module")
def halves(boxes):
    """One box is two pieces."""
    left = np.asarray(boxes.gaussians.means)[:, 0] < -0.12
    return discovered(boxes, np.where((boxes.bodies == 1) & left, 3, boxes.bodies))


def test_two_halves_become_one_and_are_followed(boxes, halves):
    start, steps = halves
    parts = steps[-1].parts
    assert [pair for step in steps for pair in step.joined] in ([(1, 3)], [(3, 1)])
    assert max(errors_mm(boxes, start, parts, FRAMES - 1)) < 3  # a pixel is 15
    labels, bodies = np.asarray(parts.weights).argmax(-1), bodies_of(boxes, start)
    for body in (1, 2):
        names, counts = np.unique(labels[bodies == body], return_counts=True)
        assert names[counts.argmax()] != BACKGROUND
        assert counts.max() > 0.85 * counts.sum()
    assert parts.done.all()
    assert all(step.skipped == 0 and len(step.losses) == 30 for step in steps)


def test_a_discovery_goes_on_to_the_same_bits(boxes, halves):
    start, steps = halves
    again = list(follow(boxes, start, steps[1].parts, CONFIG))
    assert [step.t for step in again] == [step.t for step in steps[2:]]
    ours, theirs = again[-1].parts, steps[-1].parts
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_outcome_moves_as_the_parts_did(boxes, halves):
    start, steps = halves
    parts = steps[-1].parts
    scene, trajectory = outcome(start, parts, np.arange(FRAMES) / 15)
    assert scene.num_parts == 3
    np.testing.assert_array_equal(scene.gaussians.means, boxes.gaussians.means)
    np.testing.assert_allclose(scene.weights.sum(-1), 1, rtol=1e-5)
    np.testing.assert_allclose(trajectory.times, np.arange(FRAMES) / 15)
    moved = gaussians_at(scene, moment(trajectory, 3)).means[start.order[: start.canonical.movable.num]]
    expected = skin(parts.canonical.movable, parts.weights, parts.canonical.centers, parts.pose(3)).means
    np.testing.assert_allclose(moved, expected, atol=2e-5)
    for part in (1, 2):
        members = np.asarray(scene.labels) == part
        np.testing.assert_allclose(scene.centers[part], scene.gaussians.means[members].mean(0), atol=1e-5)


@pytest.mark.slow
def test_two_boxes_in_one_piece_are_divided(boxes):
    config = replace(CONFIG, unify=replace(CONFIG.unify, least_cut=4.5))
    start, steps = discovered(boxes, np.minimum(boxes.bodies, 1), config)
    divided = [pair for step in steps for pair in step.divided]
    assert divided
    labels, bodies = np.asarray(steps[-1].parts.weights).argmax(-1), bodies_of(boxes, start)
    of = [np.bincount(labels[bodies == body], minlength=5).argmax() for body in (1, 2)]
    assert of[0] != of[1]


@pytest.mark.parametrize("kind", ["table", "simplex"])
@pytest.mark.slow
def test_weights_in_a_table_are_followed_too(boxes, kind):
    """Once, the table itself was given away in the first step."""
    stream = replace(CONFIG.stream, iterations=3, field_rate=0.02, past=2)
    config = replace(CONFIG, weights=kind, stream=stream)
    found = choose_anchor(boxes.image, FRAMES, boxes.num_cameras, 0)
    moved = moved_pixels(boxes.image, found, boxes.num_cameras)
    masks = boxes.masks(boxes.bodies)
    start = begin(boxes, boxes.gaussians, found, moved, config, None, jax.random.key(0), masks)
    parts = first_parts(start, FRAMES, config)
    before = np.asarray(parts.weights)
    step = next(follow(boxes, start, parts, config))
    assert step.skipped == 0
    after = np.asarray(step.parts.weights)
    np.testing.assert_allclose(after.sum(-1), 1, atol=1e-5)
    assert 0 < np.abs(after - before).max() < 0.2
    np.testing.assert_array_equal(parts.weights, before)


def test_what_no_picture_needs_is_given_up(boxes, halves):
    """A piece of floor that was taken for a part is background again; the boxes stay."""
    start, steps = halves
    parts = steps[-1].parts
    weights = np.asarray(parts.weights).copy()
    bodies = bodies_of(boxes, start)
    free = int(np.flatnonzero(~np.asarray(parts.canonical.alive))[0])
    some = np.flatnonzero(bodies == 0)[:12]
    weights[some] = np.eye(weights.shape[1])[free]
    alive = np.asarray(parts.canonical.alive).copy()
    alive[free] = True
    canonical = parts.canonical._replace(alive=jnp.asarray(alive))
    params = parts.params._replace(field=jnp.log(jnp.maximum(weights, 1e-4)))
    before = parts._replace(canonical=canonical, params=params)
    after, pairs = without_needless(boxes, before, CONFIG)
    assert (free, BACKGROUND) in pairs
    kept = set(np.unique(np.asarray(after.weights).argmax(-1)).tolist())
    assert kept == set(np.unique(np.asarray(parts.weights).argmax(-1)).tolist())


def test_in_the_end_weights_that_only_tie_parts_together_are_cut(halves):
    _, steps = halves
    before = steps[-1].parts
    weights = np.asarray(before.weights)
    cut = np.asarray(settled(before, weights).weights)
    assert ((weights > 0) & (weights < 0.02)).mean() > 0.2
    assert not ((cut > 0) & (cut < 0.02)).any()
    np.testing.assert_allclose(cut.sum(-1), 1, atol=1e-6)
    np.testing.assert_array_equal(cut.argmax(-1), weights.argmax(-1))
    assert np.abs(cut - weights).max() < 0.02 * weights.shape[1]
    np.testing.assert_allclose(settled(before, cut).weights, cut, atol=1e-6)


def test_parts_that_are_touched(halves):
    _, steps = halves
    parts = steps[-1].parts
    labels = np.asarray(parts.weights).argmax(-1)
    one, other = sorted(set(np.unique(labels).tolist()) - {BACKGROUND})
    assert touching(parts, labels, one) == [BACKGROUND]  # the boxes do not touch each other
    assert other not in touching(parts, labels, one)
    weights = np.asarray(parts.weights)
    np.testing.assert_allclose(given(weights, one, other).sum(-1), 1, rtol=1e-5)
    assert (given(weights, one, other)[:, one] == 0).all()


def test_frames_go_onwards_and_then_back():
    assert order_of_frames(5, 2) == [3, 4, 1, 0]
    assert order_of_frames(3, 2) == [1, 0]


def test_nothing_joins_nothing(halves):
    _, steps = halves
    parts = steps[-1].parts
    same, pairs = joined(parts, np.arange(5))
    assert pairs == []
    assert same is parts


@pytest.mark.slow
def test_from_an_anchor_in_the_middle_both_ways(boxes):
    """Canonical is frame 2: what it needs is the scene there."""
    middle = MovingBoxes(
        [
            replace(box, turns=box.turns - box.turns[2], shifts=box.shifts - box.shifts[2])
            for box in boxes.boxes
        ]
    )
    start, steps = discovered(middle, middle.bodies, anchor=2)
    assert [step.t for step in steps] == [3, 4, 1, 0]
    for t in (0, 4):
        assert max(errors_mm(middle, start, steps[-1].parts, t)) < 3
