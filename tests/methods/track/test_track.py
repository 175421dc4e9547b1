"""The tracker from end to end on a tiny simulated table. Tolerances are for images of 96 x 72 pixels."""

import re
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax import track
from gsjax.engine.checkpoint import load, save
from gsjax.methods.track import (
    PLAN,
    AlignConfig,
    GrowConfig,
    MatchConfig,
    Track,
    TrackBatch,
    TrackConfig,
    Tracked,
    TrackedScene,
    first_pose,
    method,
    start_scene,
)
from gsjax.methods.track.grow import with_slots
from gsjax.methods.track.method import matching_reduction
from gsjax.methods.track.update import track_step
from gsjax.optim.step import Step
from gsjax.scene.gaussians import take


@pytest.fixture(scope="module")
def quick(quick):
    return replace(quick, headroom=1.51)  # unlike other modules, so that nothing is compiled yet


@pytest.fixture(scope="module")
def traced(table, started, quick):
    """(the updates of a short recording, how often the update was traced)."""
    _, frames, _ = table()
    traces = []

    def counted(*arguments):
        step = track_step(*arguments)

        def update(*args, **kwargs):
            traces.append(1)
            return step.update(*args, **kwargs)

        return Step(step.init, update)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(method, "track_step", counted)
        return list(track(started, frames[0], frames[1:], quick)), len(traces)


@pytest.fixture(scope="module")
def tracked(traced):
    return traced[0]


@pytest.mark.thorough
def test_objects_are_followed(table, started, tracked, centroid_errors):
    sequence, frames, _ = table()
    assert len(tracked) == len(frames) - 1
    for t, now in enumerate(tracked, start=1):
        assert now.step == t
        errors = centroid_errors(sequence, started, now.result.pose, t)
        assert max(errors.values()) < 5e-3, errors
        assert not now.info["skipped"]
        assert 0 < now.info["loss"] < 0.5
    assert tracked[0].compile_seconds > 0
    assert tracked[-1].compile_seconds == 0


@pytest.mark.slow
def test_what_moves_is_followed_and_not_left_behind(table, quick, centroid_errors):
    """In these frames, the gripper carries the carton while the can rolls and the ball flies."""
    sequence, frames, _ = table(11)
    start = 7
    late = sequence.select(slice(start, None))
    scene = start_scene(frames[start], late.mask(0, 0), 0, quick)
    *_, last = track(scene, frames[start], frames[start + 1 :], quick)
    moved = centroid_errors(late, scene, first_pose(scene), late.num_frames - 1)
    errors = centroid_errors(late, scene, last.result.pose, late.num_frames - 1)
    movers = [name for name, metres in moved.items() if metres > 15e-3]
    assert movers, moved
    for name in movers:
        assert errors[name] < 0.25 * moved[name], (name, errors, moved)


@pytest.mark.slow
def test_objects_are_followed_where_only_what_moves_is_redrawn(table, started, quick, centroid_errors):
    sequence, frames, _ = table()
    config = replace(
        quick,
        redraw="moving",
        matching=False,
        refine=replace(quick.refine, iterations=0),
        align=replace(quick.align, everywhere=2),
        coarseness=2,
    )
    for t, now in enumerate(track(started, frames[0], frames[1:], config), start=1):
        errors = centroid_errors(sequence, started, now.result.pose, t)
        assert max(errors.values()) < 5e-3, errors
        assert not now.info["skipped"]
    with pytest.raises(ValueError, match=r"redraw: expected all if refine.iterations is above 0"):
        replace(quick, redraw="moving")


@pytest.mark.parametrize(
    ("config", "changes", "message"),
    [
        (AlignConfig, {"everywhere": -1}, "track.align.everywhere: expected at least 0, found -1"),
        (AlignConfig, {"shading": float("nan")}, "track.align.shading: expected at least 0, found nan"),
        (
            AlignConfig,
            {"turns": (0.2, -0.2)},
            "track.align.turns: expected more than 0 and at most pi, found",
        ),
        (AlignConfig, {"color_scale": 0}, "track.align.color_scale: expected more than 0, found 0"),
        (MatchConfig, {"min_score": float("nan")}, "track.match.min_score: expected at least -1, found nan"),
        (GrowConfig, {"min_gap": -0.1}, "track.grow.min_gap: expected more than 0, found -0.1"),
        (TrackConfig, {"headroom": 0.9}, "track.headroom: expected at least 1, found 0.9"),
    ],
)
def test_settings_without_meaning_are_refused(config, changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        config(**changes)


def test_labels_keep_the_masks_values(table, started):
    _, _, mask = table()
    assert started.label_ids[0] == 0
    assert started.label_ids[-4:] == (2, 3, 4, 5)  # the robot, 1, is too long to be rigid, so it is split
    assert set(started.label_ids) == set(np.unique(mask).tolist())
    labels = np.asarray(started.labels)
    assert (labels[: started.num_moving] > 0).all()
    assert (labels[started.num_moving :] == 0).all()


@pytest.mark.thorough
def test_each_gaussian_knows_its_objects_mask_value(started):
    scene = with_slots(started, 5)
    found = np.asarray(Tracked(scene, first_pose(scene)).mask_values)
    empty = np.asarray(scene.labels) == scene.num_objects + 1
    assert empty.sum() == 5
    assert (found[empty] == -1).all()
    labels = np.asarray(scene.labels)[~empty]
    np.testing.assert_array_equal(found[~empty], np.asarray(scene.label_ids)[labels])


@pytest.mark.thorough
def test_what_joins_an_object_comes_after_its_first_gaussians(started, tracked):
    """docs/track.md relies on this for the path of an object."""
    groups = np.asarray(started.labels)[: started.num_moving]
    mine = np.asarray(started.label_ids)[groups] == 3
    assert 0 < mine.sum() < len(mine)
    for now in tracked:
        np.testing.assert_array_equal(np.asarray(now.result.mask_values)[: len(mine)] == 3, mine)
        assert np.isfinite(now.result.pose.means[: len(mine)][mine].mean(0)).all()


@pytest.mark.thorough
def test_the_first_tick_has_the_time_of_compiling(tracked):
    assert tracked[0].compile_seconds > tracked[1].compile_seconds


@pytest.mark.thorough
def test_going_on_from_pose_and_state_is_the_same_as_never_stopping(table, started, tracked, quick):
    _, frames, _ = table()
    rest = track(started, frames[1], frames[2:], quick, after=tracked[0])
    for again, before in zip(rest, tracked[1:], strict=True):
        assert again.step == before.step
        jax.tree.map(np.testing.assert_array_equal, again.result, before.result)


@pytest.mark.thorough
def test_a_tick_is_stored_and_gone_on_with(table, started, tracked, quick, tmp_path):
    _, frames, _ = table()
    save(tmp_path / "run.npz", tracked[1])
    now = load(tmp_path / "run.npz")
    assert now.method == tracked[1].method
    np.testing.assert_array_equal(now.result.gaussians().means, tracked[1].result.gaussians().means)
    (last,) = track(started, frames[2], frames[3:], quick, after=now)
    jax.tree.map(np.testing.assert_array_equal, last.result, tracked[2].result)


@pytest.mark.slow
def test_the_background_moves_only_where_it_is_told_to(table, started, tracked, quick):
    _, frames, _ = table()
    background = np.asarray(started.gaussians.means)[started.num_moving :]
    np.testing.assert_array_equal(background_of(tracked[0].result.scene), background)
    config = replace(quick, refine=replace(quick.refine, background_rate=1e-4))
    (now,) = track(started, frames[0], frames[1:2], config)
    moved = np.linalg.norm(background_of(now.result.scene) - background, axis=-1)
    assert 1e-5 < moved.max() < 1e-4 * quick.refine.iterations * 3**0.5 * 1.5


def background_of(scene: TrackedScene) -> np.ndarray:
    return np.asarray(scene.gaussians.means)[scene.num_moving :]


@pytest.mark.slow
def test_parts_of_the_tracker_can_be_left_out(table, started, tracked, quick, centroid_errors):
    """Without matching, nothing is found; without a warm start, the last motion has no effect."""
    sequence, frames, _ = table()
    config = replace(quick, warm_start=False, matching=False)
    before, last = tracked[0], tracked[1]
    (now,) = track(started, frames[1], frames[2:3], config, after=before)
    assert last.info["found"].any()
    assert not now.info["found"].any()
    state = before.run.state
    hurled = state._replace(motion=jax.tree.map(lambda a: a + 0.05, state.motion))
    hurled = replace(before, run=before.run.having(state=hurled))
    (again,) = track(started, frames[1], frames[2:3], config, after=hurled)
    jax.tree.map(np.testing.assert_array_equal, again.result.pose, now.result.pose)
    errors = centroid_errors(sequence, started, now.result.pose, 2)
    assert max(errors.values()) < 10e-3, errors


@pytest.mark.slow
def test_an_overflow_changes_nothing_and_track_plans_again(table, started, tracked, quick):
    """With capacities too small for the scene, in the step alone and then in `track`."""
    _, frames, _ = table()
    tracker = Track(quick)
    shape, run = tracker.start(started, frames[0])
    plan = run.plans[PLAN]
    small = replace(plan, num_near=16, full=replace(plan.full, capacity=4096))
    update = jax.jit(partial(tracker.step(shape).update, step=0, key=jax.random.key(0)))
    run = run.having(state=update(run.params, run.state, TrackBatch(frames[0], plan))[1])
    params, state, info = update(run.params, run.state, TrackBatch(frames[1], small))
    assert info["overflow"]
    assert info["skipped"]
    jax.tree.map(np.testing.assert_array_equal, (params, state), (run.params, run.state))
    assert not np.any(info["motion"].twists)
    np.testing.assert_array_equal(info["turn_known"], state.watch.turn_known)

    before = replace(tracked[0], run=run.having(plans={PLAN: small}))
    (now,) = track(started, frames[0], frames[1:2], quick, after=before)
    plan = now.run.plans[PLAN]
    assert plan.num_near >= int(info["needed"].num_near) > 16
    assert plan.full.capacity >= int(info["needed"].full) > 4096
    assert not now.info["overflow"]
    # Rounding decides between two rotations of a part of the arm that agree equally well: a millimetre.
    own = slice(started.num_moving)
    np.testing.assert_allclose(now.result.pose.means[own], tracked[0].result.pose.means[own], atol=2e-3)


@pytest.mark.thorough
def test_an_update_is_traced_once(traced):
    updates, traces = traced
    assert len(updates) == 3
    assert traces == 1


@pytest.mark.thorough
@pytest.mark.parametrize("what", ["images", "depths"])
@pytest.mark.parametrize("value", [jnp.nan, jnp.inf])
def test_a_few_broken_pixels_are_counted_and_change_little(table, started, tracked, quick, what, value):
    _, frames, _ = table()
    pixels = getattr(frames[1], what).at[0, 30:34, 40:50].set(value)
    broken = eqx.tree_at(lambda f: getattr(f, what), frames[1], pixels)
    (now,) = track(started, frames[0], [broken], quick)
    assert now.info["broken_pixels"] == 40
    assert not now.info["skipped"]
    pose = now.result.pose
    jax.tree.map(lambda a: np.testing.assert_array_equal(jnp.isfinite(a), True), (pose, now.run.state))
    moved = np.linalg.norm(np.asarray(pose.means - tracked[0].result.pose.means), axis=-1)
    assert np.median(moved[: started.num_moving]) < 1e-3


@pytest.mark.slow
def test_the_first_frame_may_have_broken_pixels(table, quick):
    _, frames, mask = table()
    depths = frames[0].depths.at[0, 3, 4].set(jnp.inf).at[1, 5, 6].set(jnp.nan)
    broken = eqx.tree_at(lambda f: f.depths, frames[0], depths)
    with pytest.warns(UserWarning, match="2 pixels that are not finite"):
        scene = start_scene(broken, mask, 0, quick)
    assert jnp.isfinite(scene.gaussians.means).all()


@pytest.mark.slow
def test_going_on_works_when_every_slot_is_taken(table, started, quick):
    _, frames, _ = table()
    config = replace(quick, grow=replace(quick.grow, slots=2))
    *_, full = track(started, frames[0], frames[1:3], config)
    assert full.info["joined"] == 2
    (rest,) = track(started, frames[2], frames[3:], config, after=full)
    assert len(rest.result.pose.means) == len(full.result.pose.means)


@pytest.mark.thorough
def test_a_frame_of_another_size_is_named(table, started, quick):
    _, frames, _ = table()
    small = jax.tree.map(lambda a: a, frames[1])
    small = eqx.tree_at(lambda f: (f.images, f.depths), small, (small.images[:, :60], small.depths[:, :60]))
    with pytest.raises(ValueError, match=r"found \(2, 60, 96, 3\) in frame 1 after it"):
        list(track(started, frames[0], [small], quick))


@pytest.mark.thorough
@pytest.mark.parametrize("slots", [0, 64])
def test_one_object_larger_than_its_template_is_reduced(started, table, slots):
    _, frames, _ = table()
    carton = started.label_ids.index(2)
    labels = jnp.where(started.labels == carton, 1, 0)
    order = jnp.argsort(labels == 0, stable=True)
    alone = TrackedScene(
        take(started.gaussians, order),
        started.normals[: int(labels.sum())],
        labels[order],
        (0, 2),
        int(labels.sum()),
    )
    scene = with_slots(alone, slots) if slots else alone
    config = TrackConfig(matching=True, coarseness=1, match=MatchConfig(patch=8))
    reductions = [matching_reduction(one, frames[0], config) for one in (scene, alone)]
    assert reductions[0] == reductions[1] > 1
    assert matching_reduction(scene, frames[0], replace(config, matching=False)) == 1


@pytest.mark.thorough
def test_what_is_behind_a_camera_does_not_reduce_the_pictures(started, table):
    _, frames, _ = table()
    behind = jnp.diag(jnp.array([-1.0, 1.0, -1.0, 1.0])) @ frames[0].cameras.viewmat
    turned = eqx.tree_at(lambda f: f.cameras.viewmat, frames[0], behind)
    assert matching_reduction(started, turned, TrackConfig(matching=True, coarseness=1)) == 1


@pytest.mark.thorough
def test_what_is_beside_the_pictures_does_not_reduce_them(started, table):
    _, frames, _ = table()
    frame = replace(frames[0], cameras=jax.tree.map(lambda a: a[:1], frames[0].cameras))
    viewmat = frame.cameras.viewmat[0]
    spread = jnp.linspace(0, 1, started.gaussians.num)[:, None]
    local = jnp.array([3.0, 3.0, 0.05]) + spread  # below and to the right of the picture
    means = (local - viewmat[:3, 3]) @ viewmat[:3, :3]
    beside = eqx.tree_at(lambda s: s.gaussians.means, started, means)
    assert matching_reduction(beside, frame, TrackConfig(matching=True, coarseness=1)) == 1


@pytest.mark.slow
def test_a_still_scene_stays_still(table, quick):
    _, frames, mask = table(still=True)
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    drift = np.linalg.norm(
        np.asarray(last.result.pose.means[: scene.num_moving] - first_pose(scene).means), axis=-1
    )
    assert drift.mean() < 1e-3


@pytest.mark.slow
def test_one_camera_is_enough(table, quick, centroid_errors):
    sequence, frames, mask = table(cameras=1)
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    errors = centroid_errors(sequence, scene, last.result.pose, len(frames) - 1)
    assert max(errors.values()) < 8e-3, errors


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["leave", "hide"])
def test_an_object_that_is_gone_does_not_disturb_the_others(table, quick, centroid_errors, fate):
    sequence, frames, mask = table(frames=26, **{fate: True})
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    assert jnp.isfinite(last.result.pose.means).all()
    errors = centroid_errors(sequence, scene, last.result.pose, len(frames) - 1)
    assert errors["block"] < 5e-3, errors
    assert errors["carton"] < 15e-3, errors
