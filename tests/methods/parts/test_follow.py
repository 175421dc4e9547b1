"""Complete discoveries on boxes with full ground truth."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.methods.parts import (
    BACKGROUND,
    DiscoverConfig,
    Parts,
    PartsConfig,
    RefineConfig,
    StreamConfig,
    UnifyConfig,
    begin,
    choose_anchor,
    gaussians_at,
    moment,
    moved_pixels,
    order_of_frames,
    prune_parts,
)
from gsjax.methods.parts.discovery import adjacent_parts, close_frame, join_parts, weights_of_run
from gsjax.methods.parts.finish import cut_weights, moved_weights
from gsjax.methods.parts.pictures import Problem
from gsjax.methods.parts.timeline import apply, parse_script
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.handles import skin
from tests.methods.parts.moving_boxes import Box, MovingBoxes, linear

FRAMES = 5
CONFIG = PartsConfig(
    discover=DiscoverConfig(most_parts=4, lift_iterations=9),
    stream=StreamConfig(iterations=30, coarse=0.0),
    unify=UnifyConfig(every=2, noise=0.7),
    refine=RefineConfig(iterations=0),
    grid=FeatureGridConfig(4, 4, 32, 12, 2, 16),
)
skinned = jax.jit(skin)


@pytest.fixture(scope="module")
def boxes():
    first = Box(
        (-0.12, 0, 0.05), (0.12, 0.08, 0.1), linear(FRAMES, (0, 0, 0.4)), linear(FRAMES, (0, 0.08, 0))
    )
    second = Box(
        (0.14, -0.02, 0.04), (0.08, 0.1, 0.08), linear(FRAMES, (0, 0, 0)), linear(FRAMES, (0.0, -0.08, 0))
    )
    return MovingBoxes([first, second])


def begun(views, pieces, config=CONFIG, anchor=0):
    """The method, its problem, and the run before the first step."""
    found = choose_anchor(views.image, views.num_frames, views.num_cameras, anchor)
    moved = moved_pixels(views.image, found, views.num_cameras)
    start = begin(views, views.gaussians, found, moved, config, None, jax.random.key(0), views.masks(pieces))
    return Parts(config), *Parts(config).start(views, start)


class Followed:
    """A run in which parts are followed through all frames.

    Attributes:
        method, problem: the method and its problem.
        steps, order: `info` of each step, and its frame.
        run: the run at the end, with the pose of the last frame.
        parts, weights: the discovery, and the weights of the movable Gaussians.
        result: the result of the last tick.
    """

    def __init__(self, views, pieces, config=CONFIG, anchor=0):
        self.method, self.problem, run = begun(views, pieces, config, anchor)
        self.steps, self.order = [], []
        for now in drive(self.method, self.problem, run):
            self.steps.append(now.info)
            self.order.append(now.run.kept.frame)
        self.run = close_frame(now.run, config)
        self.parts, self.weights = self.run.kept, np.asarray(weights_of_run(self.run))
        self.result = now.result


def bodies_of(views, parts):
    return views.bodies[parts.order[: parts.canonical.movable.num]]


def errors_mm(views, followed, t):
    """Median position error of the Gaussians of each box at frame t, millimetres."""
    parts = followed.parts
    moved = skinned(
        parts.canonical.movable, jnp.asarray(followed.weights), parts.canonical.centers, parts.pose(t)
    ).means
    true = np.asarray(views.at(t).means)[parts.order[: len(moved)]]
    off = 1000 * np.linalg.norm(np.asarray(moved) - true, axis=1)
    bodies = bodies_of(views, parts)
    return [float(np.median(off[bodies == k])) for k in range(1, len(views.boxes) + 1)]


def of_halves(boxes):
    """Pieces of the Gaussians, in which the first box is split into two."""
    left = np.asarray(boxes.gaussians.means)[:, 0] < -0.12
    return np.where((boxes.bodies == 1) & left, 3, boxes.bodies)


@pytest.fixture(scope="module")
def halves(boxes):
    return Followed(boxes, of_halves(boxes))


@pytest.mark.slow
def test_two_halves_become_one_and_are_followed(boxes, halves):
    assert halves.parts.joined in (((1, 3),), ((3, 1),))
    assert max(errors_mm(boxes, halves, FRAMES - 1)) < 3  # a pixel is 15 mm
    labels, bodies = halves.weights.argmax(-1), bodies_of(boxes, halves.parts)
    for body in (1, 2):
        names, counts = np.unique(labels[bodies == body], return_counts=True)
        assert names[counts.argmax()] != BACKGROUND
        assert counts.max() > 0.85 * counts.sum()
    assert halves.parts.done.all()
    assert len(halves.steps) == 30 * (FRAMES - 1)
    assert not any(info["skipped"] for info in halves.steps)


@pytest.mark.slow
def test_the_result_moves_as_the_parts_did_and_can_be_edited(boxes, halves):
    result, parts = halves.result, halves.parts
    scene, trajectory = result.scene, result.trajectory
    assert scene.num_parts == 3
    np.testing.assert_array_equal(scene.gaussians.means, boxes.gaussians.means)
    np.testing.assert_allclose(result.weights.sum(-1), 1, rtol=1e-5)
    np.testing.assert_allclose(trajectory.times, np.arange(FRAMES) / 15)
    np.testing.assert_array_equal(result.at(3).means, gaussians_at(scene, moment(trajectory, 3)).means)
    moved = np.asarray(result.at(3).means)[parts.order[: parts.canonical.movable.num]]
    labels = np.asarray(scene.labels)[parts.order[: parts.canonical.movable.num]]
    weights = jnp.asarray(cut_weights(halves.weights, np.asarray(parts.canonical.alive)))
    expected = skinned(parts.canonical.movable, weights, parts.canonical.centers, parts.pose(3)).means
    np.testing.assert_allclose(moved[labels > 0], np.asarray(expected)[labels > 0], atol=2e-5)
    assert result.poses(3).quats.shape == (3, 4)
    for part in (1, 2):
        members = np.asarray(scene.labels) == part
        middle = np.asarray(scene.gaussians.means)[members].mean(0)
        np.testing.assert_allclose(np.asarray(scene.centers)[part], middle, atol=1e-5)
    assert {fitted.kind for fitted in result.joints().values()} <= {"revolute", "prismatic", "free"}
    assert sorted(result.joints()) == [1, 2]
    script = parse_script("edits: [{op: speed, parts: [box], factor: 0.5}]")
    (film,) = apply(script, result.layer, {"box": 1})
    assert len(film.trajectory.times) > FRAMES


@pytest.mark.slow
def test_two_boxes_in_one_piece_are_divided(boxes):
    config = replace(CONFIG, unify=replace(CONFIG.unify, least_cut=4.5))
    followed = Followed(boxes, np.minimum(boxes.bodies, 1), config)
    assert followed.parts.divided
    labels, bodies = followed.weights.argmax(-1), bodies_of(boxes, followed.parts)
    of = [np.bincount(labels[bodies == body], minlength=5).argmax() for body in (1, 2)]
    assert of[0] != of[1]


@pytest.mark.parametrize("kind", ["table", "simplex"])
@pytest.mark.slow
def test_weights_in_a_table_are_followed_too(boxes, kind):
    """Regression test: the first step donated the table that the discovery holds."""
    stream = replace(CONFIG.stream, iterations=3, field_rate=0.02, past=2)
    config = replace(CONFIG, weights=kind, stream=stream)
    method, problem, run = begun(boxes, boxes.bodies, config)
    before = np.asarray(weights_of_run(run)).copy()
    ticks = drive(method, problem, run)
    for _ in range(3):
        now = next(ticks)
        assert not now.info["skipped"]
    after = np.asarray(weights_of_run(now.run))
    np.testing.assert_allclose(after.sum(-1), 1, atol=1e-5)
    assert 0 < np.abs(after - before).max() < 0.2
    np.testing.assert_array_equal(now.run.kept.weights, before)


@pytest.mark.slow
def test_what_no_picture_needs_is_given_up(boxes, halves):
    """A patch of floor that was taken for a part becomes background again; the boxes remain parts."""
    parts, weights = halves.parts, halves.weights.copy()
    bodies = bodies_of(boxes, parts)
    free = int(np.flatnonzero(~np.asarray(parts.canonical.alive))[0])
    some = np.flatnonzero(bodies == 0)[:12]
    weights[some] = np.eye(weights.shape[1], dtype=np.float32)[free]
    alive = np.asarray(parts.canonical.alive).copy()
    alive[free] = True
    canonical = parts.canonical._replace(alive=jnp.asarray(alive))
    after = prune_parts(Problem(boxes), parts._replace(canonical=canonical), weights, CONFIG)
    assert (free, BACKGROUND) in after.joined
    kept = set(np.unique(np.asarray(after.weights).argmax(-1)).tolist())
    assert kept == set(np.unique(halves.weights.argmax(-1)).tolist())


@pytest.mark.slow
def test_in_the_end_weights_that_only_tie_parts_together_are_cut(halves):
    weights, alive = halves.weights, np.asarray(halves.parts.canonical.alive)
    cut = cut_weights(weights, alive)
    assert ((weights > 0) & (weights < 0.02)).mean() > 0.2
    assert not ((cut > 0) & (cut < 0.02)).any()
    np.testing.assert_allclose(cut.sum(-1), 1, atol=1e-6)
    np.testing.assert_array_equal(cut.argmax(-1), weights.argmax(-1))
    assert np.abs(cut - weights).max() < 0.02 * weights.shape[1]
    np.testing.assert_allclose(cut_weights(cut, alive), cut, atol=1e-6)


def test_of_many_small_weights_the_largest_is_kept():
    weights = np.full((1, 60), 0.9 / 59, np.float32)
    weights[0, 7] = 0.018
    cut = cut_weights(weights / weights.sum(), np.ones(60, bool))
    np.testing.assert_array_equal(cut[0], np.arange(60) == 7)


@pytest.mark.slow
def test_parts_that_are_touched(halves):
    parts, weights = halves.parts, halves.weights
    labels = weights.argmax(-1)
    one, other = sorted(set(np.unique(labels).tolist()) - {BACKGROUND})
    assert adjacent_parts(parts, weights, one) == [BACKGROUND]  # the boxes do not touch each other
    assert other not in adjacent_parts(parts, weights, one)
    np.testing.assert_allclose(moved_weights(weights, one, other).sum(-1), 1, rtol=1e-5)
    assert (moved_weights(weights, one, other)[:, one] == 0).all()


def test_frames_go_onwards_and_then_back():
    assert order_of_frames(5, 2) == [3, 4, 1, 0]
    assert order_of_frames(3, 2) == [1, 0]


@pytest.mark.slow
def test_nothing_joins_nothing(halves):
    same, weights = join_parts(halves.parts, halves.weights, np.arange(5))
    assert same is halves.parts
    assert weights is halves.weights


@pytest.mark.slow
def test_from_an_anchor_in_the_middle_both_ways(boxes):
    """Frame 2 is canonical, so the boxes' motions are given relative to it."""
    middle = MovingBoxes(
        [
            replace(box, turns=box.turns - box.turns[2], shifts=box.shifts - box.shifts[2])
            for box in boxes.boxes
        ]
    )
    followed = Followed(middle, middle.bodies, anchor=2)
    assert list(dict.fromkeys(followed.order)) == [3, 4, 1, 0]
    for t in (0, 4):
        assert max(errors_mm(middle, followed, t)) < 3
