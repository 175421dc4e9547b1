"""One update of the tracker as a problem with a known answer: a scene, the next images, and the true motion."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.data import Sequence
from gsjax.methods.object_tracker import StartConfig, TrackedScene, TrackerConfig, first_pose, first_state, start_scene
from gsjax.methods.object_tracker.layers import render_labels
from gsjax.methods.object_tracker.motion import Motion, group_means, move
from gsjax.methods.object_tracker.points import Points
from gsjax.methods.object_tracker.refine import RefineBatch
from gsjax.methods.object_tracker.region import near_background, near_scene, tiles_to_pixels, touched_tiles
from gsjax.methods.object_tracker.tracker import plan_tracker
from gsjax.metrics.tracking import score_object, true_labels
from gsjax.rasterize.plan import rung
from gsjax.scene.frame import Frame
from gsjax.scene.render import plan_render
from gsjax.methods.object_tracker.motion import place

CONFIG = TrackerConfig(start=StartConfig(object_pixels=2.0, background_pixels=6.0, max_extent=1.0, iterations=30))


class Update(NamedTuple):
    """What a method is given, and what it is judged by.

    Attributes:
        batch: scene, new images and region for what renders; pose and centres are of the last frame.
        last: the frame that the scene was fitted to.
        points: pixels that showed each group there, for what aligns.
        scored: the Gaussians, by group, that truly belong to the object that their group stands for.
        poses: each of those objects' true poses in both frames.
    """

    batch: RefineBatch
    last: Frame
    points: Points
    scored: dict[int, Int[np.ndarray, "n"]]
    poses: dict[int, Float[np.ndarray, "2 4 4"]]

    def errors(self, motion: Motion) -> tuple[float, float]:
        """Centroid error and mean point error, mm: means over the objects."""
        batch = self.batch
        groups = batch.scene.labels[: batch.scene.num_moving]
        moved = move(batch.pose, motion, batch.centers, groups)
        means = np.stack([batch.pose.means, moved.means])
        scores = [score_object(means[:, rows], self.poses[group]) for group, rows in self.scored.items()]
        centroid = np.mean([score.centroid_errors_mm[1] for score in scores])
        return float(centroid), float(np.mean([2 * score.point_error_mm for score in scores]))


def scene_at(sequence: Sequence, t: int, mask_camera: int) -> TrackedScene:
    """The scene fitted to frame `t`, with labels from one camera's true mask."""
    mask = sequence.mask(t, mask_camera)
    assert mask is not None
    return start_scene(sequence.frame(t), mask, mask_camera, CONFIG)


def update_of(sequence: Sequence, scene: TrackedScene, t: int, gap: int, least_mm: float = 3.0) -> Update:
    """The update from frame `t`, which `scene` was fitted to, to frame `t + gap`.

    Args:
        least_mm: objects that move less are followed but not scored.
    """
    last, frame = sequence.frame(t), sequence.frame(t + gap)
    pose, groups = first_pose(scene), np.asarray(scene.labels[: scene.num_moving])
    plan = plan_tracker(scene, pose, last, CONFIG)
    # As the tracker refines: in tiles that moving Gaussians touch, with the background that reaches there.
    tiles = touched_tiles([pose.means], last)
    near = near_background(scene, render_labels(scene, pose, last, plan.full), tiles)
    around = near_scene(scene, near, plan.num_near)
    centers = group_means(pose.means, jnp.asarray(groups), scene.num_objects)
    batch = RefineBatch(around, frame, plan.near, pose, centers, tiles_to_pixels(tiles, last))

    truth, cameras = sequence.truth, range(sequence.num_cameras)
    assert truth is not None
    views = [(sequence.mask(t, c), sequence.depth(t, c)) for c in cameras]
    labels = true_labels(pose.means, *zip(*views, strict=True), sequence.viewmats[t], sequence.Ks[t])
    scored, poses = {}, {}
    for group, value in enumerate(scene.label_ids):
        which = np.flatnonzero(truth.label_ids == value)
        rows = np.flatnonzero((groups == group) & (labels == value))
        if group == 0 or not len(which) or not len(rows):
            continue
        both = truth.poses[[t, t + gap], which[0]]
        if score_object(np.asarray(pose.means)[None, rows].repeat(2, 0), both).moved_mm >= least_mm:
            scored[group], poses[group] = rows, both
    return Update(batch, last, first_state(scene, pose, last, CONFIG, plan).pixels, scored, poses)
