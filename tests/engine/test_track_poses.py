"""Scores of the poses of tracked objects: which points represent an object, and which poses are scored."""

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data.objects import ObjectModel
from gsjax.data.simulated import tabletop
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.poses import OWN_POINTS, pose_metrics
from gsjax.methods.track import Pose, TrackedScene
from gsjax.scene.initialize import gaussians_from_points

FRAMES, EACH = 3, 20
LABELS = np.array([0, 2, 3])  # of the background, and of two of the four objects


@cache
def recording():
    return tabletop(frames=FRAMES, width=48, height=36, cameras=2)


def tracking(shift=0.0):
    """Gaussians that move as the ground truth does, but for a shift of object 3 from the second frame on."""
    rng, truth = np.random.default_rng(0), recording().truth
    local = 0.03 * rng.normal(size=(2, EACH, 3))
    means = np.einsum("tkij,knj->tkni", truth.poses[:, :2, :3, :3], local) + truth.poses[:, :2, None, :3, 3]
    means[1:, 1, :, 0] += shift
    behind = rng.normal(size=(5, 3))
    means = means.reshape(FRAMES, -1, 3).astype(np.float32)
    points = np.concatenate([means[0], behind]).astype(np.float32)
    scene = TrackedScene(
        gaussians=gaussians_from_points(points, np.full_like(points, 0.5)),
        normals=jnp.zeros((2 * EACH, 3)),
        labels=jnp.asarray(np.repeat([1, 2, 0], [EACH, EACH, 5]), jnp.int32),
        label_ids=tuple(LABELS.tolist()),
        num_moving=2 * EACH,
    )
    quats = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (2 * EACH, 1))
    return Tracking(scene, [Pose(jnp.asarray(each), quats) for each in means])


def test_an_object_without_a_model_is_what_was_tracked_of_it():
    assert recording().truth.label_ids[:2].tolist() == LABELS[1:].tolist()
    true = np.repeat([2, 3, 0], [EACH, EACH, 5])
    true[:4], true[4] = 0, -1  # four that belong to the background, and one that no camera sees
    scores = pose_metrics(tracking(shift=0.02), recording(), LABELS, true)
    assert list(scores) == [2, 3]
    assert {name: scores[2][name] for name in ("model", "points")} == {
        "model": OWN_POINTS,
        "points": EACH - 4,
    }
    assert scores[2]["add_mm"] == pytest.approx(0, abs=1e-3)
    assert scores[3]["points"] == EACH
    assert scores[3]["add_mm"] == pytest.approx(20 * (FRAMES - 1) / FRAMES, abs=1e-3)
    assert scores[3]["mssd_recall"] is None
    unlabelled = pose_metrics(tracking(), recording(), LABELS, None)
    assert unlabelled[2]["points"] == EACH
    assert set(pose_metrics(tracking(), recording(), LABELS, np.zeros(len(true), np.int64))) == set()


def test_a_model_of_the_recording_is_preferred_and_its_symmetries_count():
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    points = np.array([[0.03, 0, 0], [-0.03, 0, 0], [0, 0.02, 0.01], [0, -0.02, 0.01]])
    model = ObjectModel("models_eval/obj_000003.ply", points, 0.06, np.stack([np.eye(4), turn]))
    models = (None, model, *[None] * (len(recording().truth.names) - 2))
    sequence = replace(recording(), truth=replace(recording().truth, models=models))
    # From the second frame on, object 3 is rotated by its symmetry.
    tracked = tracking()
    centers = recording().truth.poses[:, 1]
    for t in range(1, FRAMES):
        means = np.asarray(tracked.poses[t].means).copy()
        own = (means[EACH:] - centers[t, :3, 3]) @ centers[t, :3, :3] @ turn[:3, :3]
        means[EACH:] = own @ centers[t, :3, :3].T + centers[t, :3, 3]
        tracked.poses[t] = replace(tracked.poses[t], means=jnp.asarray(means))
    score = pose_metrics(tracked, sequence, LABELS, None)[3]
    assert (score["model"], score["points"]) == (model.source, 4)
    assert score["diameter_mm"] == pytest.approx(60)
    assert score["add_s_mm"] == pytest.approx(0, abs=1e-3)
    assert score["add_mm"] == pytest.approx(1000 * 2 / 3 * np.mean([0.06, 0.06, 0.04, 0.04]), abs=1e-2)
    assert score["recall_5cm_5deg"] == pytest.approx(1 / FRAMES)
    assert (score["mssd_recall"], score["mspd_recall"]) == (1, 1)
    lone = replace(model, symmetries=np.eye(4)[None])
    models = (None, lone, *models[2:])
    sequence = replace(recording(), truth=replace(recording().truth, models=models))
    assert pose_metrics(tracked, sequence, LABELS, None)[3]["mssd_recall"] == pytest.approx(1 / FRAMES)


def test_nothing_is_scored_without_truth_or_a_second_frame():
    assert pose_metrics(tracking(), replace(recording(), truth=None), LABELS, None) == {}
    alone = replace(tracking(), poses=tracking().poses[:1])
    assert pose_metrics(alone, recording(), LABELS, None) == {}
