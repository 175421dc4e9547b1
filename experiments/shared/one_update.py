"""One update of the tracker as a problem with a known solution: a scene, the next images, the true motion."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from experiments.shared.recordings import labels_at
from gsjax.data import Sequence
from gsjax.methods.track import (
    PRESETS,
    StartConfig,
    Track,
    TrackBatch,
    Tracked,
    TrackedScene,
    first_pose,
    plan_tracker,
    shape_of,
    start_scene,
)
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.motion import Motion, group_means, move, place
from gsjax.methods.track.points import Points
from gsjax.methods.track.refine import RefineBatch
from gsjax.methods.track.region import near_background, near_scene
from gsjax.metrics.tracking import ObjectScore, score_object
from gsjax.rasterize.plan import rung
from gsjax.scene.region import tiles_to_pixels, touched_tiles
from gsjax.scene.render import plan_render

# Lighter than the tracker's own settings, since a single update is compared. A robot is one group here: each
# group is six columns of a Jacobian.
CONFIG = replace(
    PRESETS["paper"],
    start=StartConfig(object_pixels=2.0, background_pixels=6.0, max_extent=1.0, iterations=30),
)


class Update(NamedTuple):
    """The input of a method, and the truth that it is scored against.

    Attributes:
        batch: scene, new images and region, for methods that render; pose and centres are of the last frame.
        points: pixels that showed each group in the last frame, for methods that align.
        scored: for each scored group, the Gaussians that truly belong to its object.
        poses: for each scored group, its object's true poses in both frames.
    """

    batch: RefineBatch
    points: Points
    scored: dict[int, Int[np.ndarray, "n"]]
    poses: dict[int, Float[np.ndarray, "2 4 4"]]

    def scores(self, motion: Motion) -> list[ObjectScore]:
        """The score of each scored group."""
        batch = self.batch
        moved = move(batch.pose, motion, batch.centers, batch.scene.labels[: batch.scene.num_moving])
        means = np.stack([batch.pose.means, moved.means])
        return [score_object(means[:, rows], self.poses[group]) for group, rows in self.scored.items()]

    def errors(self, motion: Motion) -> tuple[float, float]:
        """Centroid error and mean point error in the new frame, mm: means over the scored groups."""
        scores = self.scores(motion)
        centroids = [score.centroid_errors_mm[1] for score in scores]
        # The mean is over both frames, and the first has no error.
        return float(np.mean(centroids)), float(np.mean([2 * score.point_error_mm for score in scores]))


def scene_at(sequence: Sequence, t: int, mask_camera: int) -> TrackedScene:
    """The scene fitted to frame `t`, with labels from one camera's true mask."""
    mask = sequence.mask(t, mask_camera)
    assert mask is not None
    return start_scene(sequence.frame(t), mask, mask_camera, CONFIG)


def update_of(
    sequence: Sequence,
    scene: TrackedScene,
    t: int,
    gap: int,
    *,
    least_mm: float = 3.0,
    reach: float = 0.0,
) -> Update:
    """The update from frame `t`, which `scene` was fitted to, to frame `t + gap`.

    Args:
        least_mm: objects that move less are followed but not scored.
        reach: how far from the last pose methods may start, metres; the region covers that too.
    """
    last, frame = (sequence.frame(at) for at in (t, t + gap))
    pose, groups = first_pose(scene), np.asarray(scene.labels[: scene.num_moving])
    plan = plan_tracker(scene, pose, last, CONFIG)
    # As in the tracker's refinement: tiles that moving Gaussians touch, with the background reaching there.
    sides = reach * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]).astype(np.float32)
    tiles = touched_tiles([pose.means + side for side in sides], last)
    near = near_background(scene, render_labels(scene, pose, last, plan.full), tiles)
    around = near_scene(scene, near, rung(int(near.sum())))
    centers = group_means(pose.means, jnp.asarray(groups), scene.num_objects)
    near_plan = plan_render(place(around, pose), last.cameras, headroom=CONFIG.headroom)
    batch = RefineBatch(around, frame, near_plan, pose, centers, tiles_to_pixels(tiles, last))
    step, params = Track(CONFIG).step(shape_of(last)), Tracked(scene, pose)
    look = jax.jit(partial(step.update, step=0, key=jax.random.key(0)))
    points = look(params, step.init(params), TrackBatch(last, plan))[1].pixels

    truth = sequence.truth
    assert truth is not None
    labels = labels_at(sequence, np.asarray(pose.means), t)
    scored, poses = {}, {}
    for group, value in enumerate(scene.label_ids):
        which = np.flatnonzero(truth.label_ids == value)
        rows = np.flatnonzero((groups == group) & (labels == value))
        if group == 0 or not len(which) or not len(rows):
            continue
        both = truth.poses[[t, t + gap], which[0]]
        if score_object(np.asarray(pose.means)[None, rows].repeat(2, 0), both).moved_mm >= least_mm:
            scored[group], poses[group] = rows, both
    return Update(batch, points, scored, poses)
