"""Surfaces that come into view join the object they continue, and nothing else does."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.spherical_harmonics import SH_C0
from gsjax.methods.track import first_pose, render_labels
from gsjax.methods.track.config import GrowConfig
from gsjax.methods.track.grow import (
    _draw,
    _nearest,
    empty_slots,
    grow,
    unexplained,
    with_slots,
)
from gsjax.methods.track.layers import shown_by
from gsjax.methods.track.scene import EMPTY
from gsjax.metrics.tracking import true_labels
from gsjax.scene.render import plan_render, render

CARTON = 2
CONFIG = GrowConfig(candidates=64, distance=0.03)  # a pixel of this small table is a centimetre wide


@pytest.fixture(scope="module")
def plan(table, started):
    return plan_render(started.gaussians, table()[1][0].cameras, headroom=2.0)


@pytest.fixture(scope="module")
def torn(started):
    """The scene without one half of the carton, as if it had never been seen."""
    member = np.asarray(started.labels) == started.label_ids.index(CARTON)
    means, logits = map(np.array, (started.gaussians.means, started.gaussians.logit_opacities))
    gone = member & (means[:, 0] > np.median(means[member, 0]))
    logits[gone], means[gone] = EMPTY, 100.0
    far, logits = jnp.asarray(means), jnp.asarray(logits)
    return eqx.tree_at(lambda s: (s.gaussians.logit_opacities, s.gaussians.means), started, (logits, far))


@partial(jax.jit, static_argnums=5)
def grown_once(scene, pose, frame, plan, step, config):
    shown = shown_by(render_labels(scene, pose, frame, plan))
    return grow(scene, pose, shown, frame, step, config)


def grown(scene, frame, plan, steps=1, config=CONFIG):
    pose = first_pose(scene)
    for step in range(steps):
        scene, pose = grown_once(scene, pose, frame, plan, step, config)
    return scene, pose


draw = jax.jit(_draw, static_argnums=2)
labels_of = jax.jit(render_labels)


@pytest.mark.parametrize(
    ("size", "num_chosen"),
    [(1000, 0), (1000, 3), (1000, 16), (1000, 700), (1000, 1000), (600, 50), (63, 63), (65, 20), (1, 1)],
)
def test_some_of_the_chosen_places_are_drawn_and_over_time_all_of_them(size, num_chosen):
    count = 16
    chosen = np.zeros(size, bool)
    chosen[np.random.default_rng(0).permutation(size)[:num_chosen]] = True
    taken = set()
    for step in range(400):
        places, real = map(np.asarray, draw(chosen, step, count))
        assert chosen[places[real]].all()
        assert len(set(places[real].tolist())) == real.sum() <= num_chosen
        assert ((places >= 0) & (places < size)).all()
        assert real.all() or num_chosen < 20 * count
        taken |= set(places[real].tolist())
    assert taken == set(np.flatnonzero(chosen)) if num_chosen <= count else len(taken) > 0.9 * num_chosen


@pytest.mark.slow
@pytest.mark.parametrize("none_taken", [False, True])
def test_the_nearest_is_that_of_all_distances(started, none_taken):
    """Also where the number of Gaussians is no multiple of the lane width; empty slots are no neighbours."""
    scene = with_slots(started, 32)
    if none_taken:
        scene = eqx.tree_at(lambda s: s.labels, scene, jnp.full_like(scene.labels, scene.num_objects + 1))
    assert scene.gaussians.num % 256
    key = jax.random.key(0)
    own_colors = scene.gaussians.sh0[:, 0] * SH_C0 + 0.5
    own = np.c_[scene.gaussians.means / CONFIG.distance, own_colors / CONFIG.color]
    rows = jnp.r_[jax.random.permutation(key, scene.gaussians.num)[:40], scene.gaussians.num - 1]
    points = scene.gaussians.means[rows] + 0.004 * jax.random.normal(key, (41, 3))
    colors = jax.random.uniform(key, (41, 3))
    label, distance = _nearest(points, colors, scene, first_pose(scene), CONFIG)
    ask = np.c_[points / CONFIG.distance, colors / CONFIG.color]
    all_distances = np.linalg.norm(own[:, None] - ask, axis=-1)
    all_distances[np.asarray(scene.labels) > scene.num_objects] = np.inf
    np.testing.assert_allclose(distance, all_distances.min(0), rtol=1e-4)
    if not none_taken:
        np.testing.assert_array_equal(label, np.asarray(scene.labels)[all_distances.argmin(0)])


@pytest.mark.thorough
def test_slots_draw_nothing_and_belong_to_nobody(table, started, plan):
    frame = table()[1][0]
    slotted = with_slots(started, 256)
    assert slotted.num_moving == started.num_moving + 256
    assert int(empty_slots(slotted).sum()) == 256
    assert not empty_slots(started).any()
    before = render(started.gaussians, frame.cameras, plan)
    after = render(slotted.gaussians, frame.cameras, plan)
    np.testing.assert_allclose(after.colors, before.colors, atol=1e-6)
    labels = np.asarray(labels_of(slotted, first_pose(slotted), frame, plan).features)
    assert labels.shape[-1] == started.num_objects + 1


@pytest.mark.thorough
def test_what_is_missing_joins_the_object_that_it_continues(table, torn, plan):
    sequence, frames, _ = table()
    scene, pose = grown(with_slots(torn, 256), frames[0], plan, steps=6)
    new = slice(torn.num_moving, scene.num_moving)
    joined = ~np.asarray(empty_slots(scene))[new]
    values = np.asarray(scene.label_ids)[np.asarray(scene.labels)[new][joined]]
    assert (values == CARTON).sum() >= 8  # one pixel in four is examined
    where = np.asarray(pose.means)[new][joined]
    masks, depths = [[np.asarray(a(0, c)) for c in range(2)] for a in (sequence.mask, sequence.depth)]
    truth = true_labels(where, masks, depths, list(sequence.viewmats[0]), list(sequence.Ks[0]))
    assert (truth[values == CARTON] == CARTON).mean() > 0.9
    # They are rendered with the label of the object.
    drawn = np.asarray(labels_of(scene, pose, frames[0], plan).features)
    share = drawn[..., scene.label_ids.index(CARTON)] > 0.5
    torn_share = np.asarray(labels_of(torn, first_pose(torn), frames[0], plan).features)
    assert share.sum() > (torn_share[..., torn.label_ids.index(CARTON)] > 0.5).sum() + 30


@pytest.mark.thorough
def test_a_scene_that_explains_all_grows_little(table, started, plan):
    frame = table()[1][0]
    scene, _ = grown(with_slots(started, 256), frame, plan)
    shown = shown_by(labels_of(started, first_pose(started), frame, plan))
    assert np.asarray(unexplained(shown, frame.depths, CONFIG)).mean() < 0.02
    assert 256 - int(empty_slots(scene).sum()) <= 32


@pytest.mark.thorough
def test_full_slots_overwrite_nothing(table, torn, plan):
    frame = table()[1][0]
    few = with_slots(torn, 3)
    scene, pose = grown(few, frame, plan, steps=3)
    assert not np.asarray(empty_slots(scene)).any()
    kept = np.r_[0 : torn.num_moving, few.num_moving : few.gaussians.num]
    for after, before in ((scene.gaussians.means, few.gaussians.means), (scene.labels, few.labels)):
        np.testing.assert_array_equal(np.asarray(after)[kept], np.asarray(before)[kept])
    again, _ = grown(scene, frame, plan)
    np.testing.assert_array_equal(again.gaussians.means, scene.gaussians.means)
    assert np.isfinite(pose.means).all()


@pytest.mark.thorough
def test_no_distance_and_no_gap_so_wide_grow_nothing(table, torn, plan):
    frame = table()[1][0]
    for config in (replace(CONFIG, distance=1e-6), replace(CONFIG, min_gap=10.0)):
        scene, _ = grown(with_slots(torn, 64), frame, plan, config=config)
        assert int(empty_slots(scene).sum()) >= 60
