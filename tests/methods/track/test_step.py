"""The tracker's step as a pair of pure functions: how it composes, and what it does with frames that cannot
be read."""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import numpy as np
import pytest

from gsjax.methods.track import PLAN, PRESETS, AlignConfig, Track, TrackBatch
from gsjax.methods.track.frames import prepared
from gsjax.methods.track.grow import empty_slots

# Searches only at the last known poses, which compiles fast, and for all groups, so that none is chosen by
# rounding.
LITTLE = AlignConfig(iterations=2, reach=0.0, turns=(), pixels=32, centers=32, everywhere=None)
CONFIG = replace(PRESETS["fast"], align=LITTLE)


@pytest.fixture(scope="module")
def begun(table, started):
    """The step, its jitted update, and the run after the first frame."""
    _, frames, _ = table()
    tracker = Track(CONFIG)
    shape, run = tracker.start(started, frames[0])
    step = tracker.step(shape)
    jitted = jax.jit(step.update)

    def update(params, state, batch, step=0, key=jax.random.key(0)):  # noqa: B008
        return jitted(params, state, batch, step=step, key=key)

    params, state, _ = update(run.params, run.state, TrackBatch(frames[0], run.plans[PLAN]))
    return step, update, run.having(params=params, state=state)


def assert_same(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "config",
    [
        CONFIG,
        pytest.param(replace(CONFIG, cameras=(1,), shrink=2), marks=pytest.mark.slow),
        pytest.param(replace(CONFIG, coarseness=1, matching=True), marks=pytest.mark.slow),
        pytest.param(PRESETS["paper"], marks=pytest.mark.slow),
    ],
)
def test_a_blank_state_has_the_form_that_a_first_look_fills(table, started, config):
    _, frames, _ = table()
    tracker = Track(config)
    shape, run = tracker.start(started, frames[0])
    update = partial(tracker.step(shape).update, step=0, key=jax.random.key(0))
    _, seen, _ = jax.eval_shape(update, run.params, run.state, TrackBatch(frames[0], run.plans[PLAN]))
    assert jax.tree.structure(run.state) == jax.tree.structure(seen)
    for one, other in zip(jax.tree.leaves(run.state), jax.tree.leaves(seen), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)


@pytest.mark.thorough
def test_the_first_update_only_looks(table, started, begun):
    _, frames, _ = table()
    step, update, run = begun
    params, state, info = update(run.params, step.init(run.params), TrackBatch(frames[0], run.plans[PLAN]))
    assert not info["skipped"]
    assert not info["lost"].any()
    assert not np.any(info["motion"].twists)
    assert_same(params, Track(CONFIG).start(started, frames[0])[1].params)
    assert_same(state, run.state)
    assert int(state.count) == 0
    assert not np.any(state.motion.delta)
    assert {1, 2} <= set(np.unique(state.shown.labels))
    assert_same(state.keyframe.points, state.pixels)
    assert (np.asarray(state.watch.showed) > 0.2).all()
    assert np.asarray(state.watch.agrees == 1).all()


@pytest.mark.thorough
def test_a_first_frame_that_cannot_be_read_leaves_the_state_blank(table, begun):
    _, frames, _ = table()
    step, update, run = begun
    broken = replace(frames[0], images=np.full_like(frames[0].images, np.nan))
    _, state, info = update(run.params, step.init(run.params), TrackBatch(broken, run.plans[PLAN]))
    assert info["skipped"]
    assert_same(state, step.init(run.params))


@pytest.mark.slow
def test_it_runs_in_a_scan_as_frame_by_frame_and_grows_there(table, begun):
    _, frames, _ = table()
    step, update, run = begun
    plan = run.plans[PLAN]
    params, state = run.params, run.state
    for frame in frames[1:]:
        params, state, _ = update(params, state, TrackBatch(frame, plan))

    def body(carried, frame):
        params, state, info = step.update(*carried, TrackBatch(frame, plan), step=0, key=jax.random.key(0))
        return (params, state), info["joined"]

    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *frames[1:])
    (scanned, _), joined = jax.jit(partial(jax.lax.scan, body))((run.params, run.state), stacked)
    # With XLA's default optimisations these are the same bits. Unoptimised, rounding decides between steps of
    # half a millimetre.
    np.testing.assert_allclose(scanned.pose.means, params.pose.means, atol=1e-3)
    taken = CONFIG.grow.slots - empty_slots(scanned.scene).sum()
    assert joined[-1] == taken > 0


@pytest.mark.thorough
@pytest.mark.parametrize("what", ["images", "depths", "viewmat"])
def test_a_frame_that_cannot_be_read_changes_nothing(table, begun, what):
    _, frames, _ = table()
    _, update, run = begun
    where = {"viewmat": lambda f: f.cameras.viewmat}.get(what, lambda f: getattr(f, what))
    broken = eqx.tree_at(where, frames[1], np.full_like(where(frames[1]), np.nan))
    params, state, info = update(run.params, run.state, TrackBatch(broken, run.plans[PLAN]))
    assert info["skipped"]
    assert_same((params, state), (run.params, run.state))


@pytest.fixture(scope="module")
def in_bytes_and_floats(table):
    """The second frame with images of bytes, and the same images as floats."""
    frame = table()[1][1]
    images = np.asarray(255 * frame.images).round().astype(np.uint8)
    return [replace(frame, images=kind) for kind in (images, np.float32(images) / 255)]


def test_bytes_are_prepared_as_floats_are(in_bytes_and_floats):
    one, other = (prepared(frame, CONFIG)[0] for frame in in_bytes_and_floats)
    np.testing.assert_allclose(one.images, other.images, rtol=1e-6)


@pytest.mark.slow
def test_bytes_are_seen_as_floats_are(in_bytes_and_floats, begun):
    _, update, run = begun
    plan = run.plans[PLAN]
    found = [update(run.params, run.state, TrackBatch(f, plan))[0] for f in in_bytes_and_floats]
    np.testing.assert_allclose(found[0].pose.means, found[1].pose.means, atol=1e-5)


@pytest.mark.thorough
def test_what_draws_at_random_takes_its_key(table, begun):
    """Where no group is lost, nothing is drawn at random: another key and step give the same bits."""
    _, frames, _ = table()
    _, update, run = begun
    batch = TrackBatch(frames[1], run.plans[PLAN])
    other = update(run.params, run.state, batch, step=5, key=jax.random.key(7))
    assert_same(other[0], update(run.params, run.state, batch)[0])
