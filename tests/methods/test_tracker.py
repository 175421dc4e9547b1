"""The tracker from end to end on a tiny simulated table. Figures are millimetres at 96 x 72 pixels."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.object_tracker import first_pose, start_scene, track, tracking
from gsjax.methods.object_tracker.tracker import TrackerBatch, object_tracker, plan_tracker


@pytest.fixture(scope="module")
def tracked(table, started, quick):
    _, frames, _ = table()
    return list(track(started, frames[0], frames[1:], quick))


def test_objects_are_followed(table, started, tracked, centroid_errors):
    sequence, frames, _ = table()
    assert len(tracked) == len(frames) - 1
    for t, result in enumerate(tracked, start=1):
        errors = centroid_errors(sequence, started, result.pose, t)
        assert max(errors.values()) < 5e-3, errors
        assert not result.info["skipped"]
    assert tracked[0].compile_seconds > 0
    assert tracked[-1].compile_seconds == 0


def test_labels_keep_the_masks_values(table, started):
    _, _, mask = table()
    assert started.label_ids[0] == 0
    assert started.label_ids[-4:] == (2, 3, 4, 5)  # the robot, 1, is too long to be rigid: it comes in parts
    assert set(started.label_ids) == set(np.unique(mask).tolist())
    labels = np.asarray(started.labels)
    assert (labels[: started.num_moving] > 0).all()
    assert (labels[started.num_moving :] == 0).all()


def test_going_on_from_pose_and_state_is_the_same_as_never_stopping(table, started, tracked, quick):
    _, frames, _ = table()
    half = tracked[0]
    rest = track(half.scene, frames[1], frames[2:], quick, pose=half.pose, state=half.state)
    for again, before in zip(rest, tracked[1:], strict=True):
        np.testing.assert_allclose(again.pose.means, before.pose.means, atol=1e-5)


def test_an_overflow_changes_nothing_and_track_plans_again(table, started, tracked, quick, monkeypatch):
    """Capacities too small for the scene, in the step alone and then under `track`."""
    _, frames, _ = table()
    plan = plan_tracker(started, first_pose(started), frames[1], quick.headroom)
    small = replace(plan, num_near=16, full=replace(plan.full, capacity=4096))
    step = object_tracker(quick, started.num_objects, frames[0])
    pose = first_pose(started)
    state = step.init(pose)
    batch = TrackerBatch(started, frames[1], small)
    new, new_state, info = jax.jit(lambda p, s, b: step.update(p, s, b, step=0, key=None))(pose, state, batch)
    assert info["overflow"]
    assert info["skipped"]
    jax.tree.map(np.testing.assert_array_equal, (new, new_state), (pose, state))

    monkeypatch.setattr(tracking, "plan_tracker", lambda *_: small)
    (result,) = track(started, frames[0], frames[1:2], quick)
    assert result.plan.num_near >= int(info["needed"].num_near) > 16
    assert result.plan.full.capacity >= int(info["needed"].full) > 4096
    assert not result.info["overflow"]
    np.testing.assert_allclose(result.pose.means, tracked[0].pose.means, atol=1e-5)


def test_an_update_is_traced_once(table, started, quick, monkeypatch):
    _, frames, _ = table()
    traces = []

    def counted(*arguments):
        step = object_tracker(*arguments)

        def update(*args, **kwargs):
            traces.append(1)
            return step.update(*args, **kwargs)

        return step._replace(update=update)

    monkeypatch.setattr(tracking, "object_tracker", counted)
    config = replace(quick, headroom=1.51)  # not one that another test has compiled
    assert len(list(track(started, frames[0], frames[1:], config))) == 3
    assert len(traces) == 1


def test_pixels_that_are_not_numbers_leave_the_state_finite(table, started, quick):
    _, frames, _ = table()
    images = frames[1].images.at[0, 30:34, 40:50].set(jnp.nan)
    broken = eqx.tree_at(lambda f: f.images, frames[1], images)
    results = list(track(started, frames[0], [broken, frames[2]], quick))
    for result in results:
        assert jnp.isfinite(result.pose.means).all()
        assert jnp.isfinite(result.pose.quats).all()
        for leaf in jax.tree.leaves(result.state.motion):
            assert jnp.isfinite(leaf).all()


@pytest.mark.slow
def test_a_still_scene_stays_still(table, quick):
    _, frames, mask = table(still=True)
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    drift = np.linalg.norm(np.asarray(last.pose.means[: scene.num_moving] - first_pose(scene).means), axis=-1)
    assert drift.mean() < 1e-3


@pytest.mark.slow
def test_one_camera_is_enough(table, quick, centroid_errors):
    sequence, frames, mask = table(cameras=1)
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    errors = centroid_errors(sequence, scene, last.pose, len(frames) - 1)
    assert max(errors.values()) < 8e-3, errors


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["leave", "hide"])
def test_an_object_that_is_gone_does_not_disturb_the_others(table, quick, centroid_errors, fate):
    sequence, frames, mask = table(frames=26, **{fate: True})
    scene = start_scene(frames[0], mask, 0, quick)
    *_, last = track(scene, frames[0], frames[1:], quick)
    assert jnp.isfinite(last.pose.means).all()
    errors = centroid_errors(sequence, scene, last.pose, len(frames) - 1)
    assert errors["block"] < 5e-3, errors
    assert errors["carton"] < 15e-3, errors
