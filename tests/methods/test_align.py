"""Direct alignment finds a known motion of a textured object, and keeps away from what is not there."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.object_tracker.align import (
    Points,
    align,
    bilinear,
    disagreement,
    join,
    pixels_of_groups,
    sample_groups,
)
from gsjax.methods.object_tracker.config import AlignConfig
from gsjax.methods.object_tracker.motion import Motion, turn_about

CONFIG = AlignConfig(iterations=12)
CARTON = 2
SIZE = {"width": 160, "height": 120}


@pytest.fixture(scope="module")
def moved(table):
    """(points of the carton in frame 6, its centre, frame 7, where the points are then)."""
    sequence, frames, _ = table(8, 2, **SIZE)
    labels = np.stack([sequence.mask(6, c) for c in range(2)])
    labels = jnp.asarray(np.where(labels == CARTON, 1, 0), jnp.int32)
    points = pixels_of_groups(frames[6], labels, frames[6].depths, 1, CONFIG)
    k = sequence.truth.names.index("carton")
    motion = sequence.truth.poses[7, k] @ np.linalg.inv(sequence.truth.poses[6, k])
    then = np.asarray(points.means, np.float64) @ motion[:3, :3].T + motion[:3, 3]
    seen = np.asarray(points.seen).any(0)
    return points, points.means[seen].mean(0)[None], frames[7], then, labels


def run(points, center, frame, config=CONFIG):
    start = Motion(jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    found = align(start, points, center, frame, config)
    twists = jnp.concatenate([found.translations, found.rotations], axis=-1)
    return found, np.asarray(turn_about(points.means, twists, center, points.groups))


def error(points, means, then):
    seen = np.asarray(points.seen).any(0)
    return np.linalg.norm(means - then, axis=-1)[seen].mean()


def without_depth(frame):
    return eqx.tree_at(lambda f: f.depths, frame, None, is_leaf=lambda x: x is None)


def test_a_known_motion_is_found_and_agrees_better(moved):
    points, center, frame, then, _ = moved
    before = error(points, np.asarray(points.means), then)
    _, means = run(points, center, frame)
    assert error(points, means, then) < min(1.5e-3, before), before
    start, end = (disagreement(points, m, 1, frame, CONFIG)[0] for m in (points.means, jnp.asarray(means)))
    assert end < start


def test_colour_alone_finds_it_too(moved):
    points, center, frame, then, _ = moved
    _, means = run(points, center, without_depth(frame))
    assert error(points, means, then) < 4e-3


def test_something_in_front_does_not_pull(moved):
    points, center, frame, then, _ = moved
    row, column = np.argwhere(np.asarray(moved[4][0]) == 1).mean(0).astype(int)
    patch = (0, slice(row, row + 6), slice(column - 20, column + 20))
    hidden = eqx.tree_at(
        lambda f: (f.images, f.depths),
        frame,
        (frame.images.at[patch].set(jnp.array([0.1, 0.9, 0.1])), frame.depths.at[patch].set(0.4)),
    )
    _, means = run(points, center, hidden)
    assert error(points, means, then) < 2e-3


@pytest.mark.parametrize("depth", [True, False])
def test_a_group_that_nobody_sees_stands_still(moved, depth):
    points, center, frame, _, _ = moved
    unseen = points._replace(seen=jnp.zeros_like(points.seen))
    found, _ = run(unseen, center, frame if depth else without_depth(frame))
    np.testing.assert_allclose(found.translations, 0, atol=1e-6)
    np.testing.assert_allclose(found.rotations, 0, atol=1e-6)
    assert disagreement(unseen, points.means, 1, frame, CONFIG)[0] == 0


def test_disagreement_is_nothing_for_a_perfect_fit_and_half_outside_the_picture(moved, table):
    points = moved[0]
    _, frames, _ = table(8, 2, **SIZE)
    assert disagreement(points, points.means, 1, frames[6], CONFIG)[0] < 1e-3
    away = points.means + jnp.array([0.0, 50.0, 0.0])
    np.testing.assert_allclose(disagreement(points, away, 1, frames[6], CONFIG), 0.5, atol=1e-6)


def test_only_pixels_of_the_group_are_picked(moved, table):
    points, labels = moved[0], np.asarray(moved[4])
    _, frames, _ = table(8, 2, **SIZE)
    for c in range(2):
        chosen = np.asarray(points.seen[c]) > 0
        assert chosen.sum() == min(CONFIG.pixels, (labels[c] == 1).sum())
        colors = np.asarray(frames[6].images[c])[labels[c] == 1]
        assert {tuple(row) for row in np.asarray(points.colors)[chosen]} <= {tuple(row) for row in colors}


def test_samples_are_capped_and_never_strangers():
    groups = jnp.asarray([1] * 30 + [2] * 3 + [4] * 7)
    means = jnp.tile(groups[:, None].astype(jnp.float32), (1, 3))
    few = sample_groups(Points(means, means, groups, jnp.ones((2, 40))), 4, 8)
    assert few.means.shape == (32, 3)
    real = np.asarray(few.seen[0]) > 0
    np.testing.assert_array_equal(np.bincount(np.asarray(few.groups)[real], minlength=5), [0, 8, 3, 0, 7])
    np.testing.assert_array_equal(few.means[real, 0], few.groups[real])
    both = join(few, few)
    assert both.seen.shape == (2, 64)
    assert both.groups.shape == (64,)


def test_bilinear_reads_between_pixel_centres():
    image = jnp.asarray(np.mgrid[0:4, 0:5].transpose(1, 2, 0) + 0.5, jnp.float32)  # (row, column) of centres
    places = jnp.array([[2.3, 1.7], [0.5, 0.5], [4.5, 3.5]])
    np.testing.assert_allclose(bilinear(image, places), places[:, ::-1], atol=2e-3)
