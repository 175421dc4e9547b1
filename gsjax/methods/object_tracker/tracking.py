"""The host's side of tracking: compile once, feed frames, re-plan when a plan has become too small."""

import time
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.methods.object_tracker.config import TrackerConfig
from gsjax.methods.object_tracker.fit import fit_scene
from gsjax.methods.object_tracker.grow import empty_slots, grow, with_slots
from gsjax.methods.object_tracker.motion import Pose, first_pose, place
from gsjax.methods.object_tracker.region import TrackerPlan
from gsjax.methods.object_tracker.scene import TrackedScene, labelled_cloud, scene_from_cloud
from gsjax.methods.object_tracker.tracker import (
    TrackerBatch,
    TrackerState,
    object_tracker,
    plan_tracker,
    render_labels,
)
from gsjax.optim.compiler import host_options
from gsjax.optim.step import keep_if
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians


class Tracked(NamedTuple):
    """The scene after one frame.

    Attributes:
        scene: the scene, with slots for what joins objects and what has joined so far.
        pose: where the moving Gaussians are now.
        state: what the tracker carries to the next frame.
        info: losses and matches by name; see `object_tracker`.
        seconds: from images in memory to the new state, re-planning included; compilation apart.
        compile_seconds: what compiling took before that; 0 but for the first frame and after re-plans.
        plan: the plan it ran under.
    """

    scene: TrackedScene
    pose: Pose
    state: TrackerState
    info: dict[str, Any]
    seconds: float
    compile_seconds: float
    plan: TrackerPlan

    def gaussians(self) -> Gaussians:
        """The whole scene as it stands now."""
        return place(self.scene, self.pose)


def start_scene(
    frame: Frame, mask: np.ndarray, mask_camera: int = 0, config: TrackerConfig | None = None
) -> TrackedScene:
    """A labelled, photometrically optimised scene from the first RGB-D frame and one camera's mask.

    Args:
        frame: what the cameras see at first, with depth.
        mask: labels [H, W] of one camera's image; 0 is background.
        mask_camera: which camera of the frame the mask belongs to, counted from 0.

    Raises:
        ValueError: there is no depth, or the mask does not fit the images.
    """
    config = TrackerConfig() if config is None else config
    scene = scene_from_cloud(labelled_cloud(frame, mask, mask_camera, config.start), config.start)
    return fit_scene(scene, frame, config.start.iterations, config.headroom)[0]


@partial(jax.jit, static_argnames=("config", "num_objects", "reduction"))
def _update(pose, state, batch, step, config: TrackerConfig, num_objects: int, reduction: int):
    tracker = object_tracker(config, num_objects, state.frame, reduction)
    scene, frame, plan = batch
    moved, new_state, info = tracker.update(pose, state, batch, step=step, key=None)
    info["joined"] = jnp.int32(0)
    if not config.grow.slots or frame.depths is None:
        return scene, moved, new_state, info
    rendered = render_labels(scene, moved, frame, plan.full)
    full = jnp.maximum(info["needed"].full, rendered.meta.needed.max())
    overflow = info["overflow"] | rendered.meta.overflow.any()
    grown = grow(scene, moved, rendered, frame, new_state.count, config.grow)
    info |= {"needed": info["needed"]._replace(full=full), "overflow": overflow}
    info["skipped"] |= overflow
    scene, pose, state = keep_if(~info["skipped"], (*grown, new_state), (scene, pose, state))
    info["joined"] = config.grow.slots - empty_slots(scene).sum()
    return scene, pose, state, info


def track(
    scene: TrackedScene,
    first: Frame,
    frames: Iterable[Frame],
    config: TrackerConfig | None = None,
    *,
    pose: Pose | None = None,
    state: TrackerState | None = None,
) -> Iterator[Tracked]:
    """Follow the objects of `scene` through `frames` (those after the first one), one `Tracked` a frame.

    Nothing is compiled between frames, unless a plan overflows: then the frame is done again under the next
    rung, from the state before it, so nothing is lost.

    Args:
        scene: from `start_scene` or `scene_from_shapes`.
        first: the frame that `scene` or `pose` shows.
        frames: the frames after it, in order of time; all of one size and number of cameras.
        config: see `TrackerConfig`.
        pose, state: where to go on from, with the same `Tracked`'s scene; the first frame unless given.
    """
    config = TrackerConfig() if config is None else config
    if config.grow.slots and first.depths is not None and not empty_slots(scene).any():
        scene = with_slots(scene, config.grow.slots)
    pose = first_pose(scene) if pose is None else pose
    step = object_tracker(config, scene.num_objects, first)
    state = step.init(pose) if state is None else state
    plan: TrackerPlan | None = None
    compiled: dict[TrackerPlan, Any] = {}
    for index, frame in enumerate(frames):
        if plan is None:
            plan = plan_tracker(scene, pose, frame, config.headroom)
            reduction = _reduction(scene, frame, config)
        jax.block_until_ready(frame)
        seconds = compile_seconds = 0.0
        while True:
            batch = TrackerBatch(scene, frame, plan)
            arguments = (pose, state, batch, index)
            if plan not in compiled:
                begun = time.perf_counter()
                static = {"config": config, "num_objects": scene.num_objects, "reduction": reduction}
                compiled[plan] = _update.lower(*arguments, **static).compile(host_options())
                compile_seconds += time.perf_counter() - begun
            begun = time.perf_counter()
            result = jax.block_until_ready(compiled[plan](*arguments))
            seconds += time.perf_counter() - begun
            info = result[3]
            if not bool(info["overflow"]):
                break
            plan = plan.grown(info["needed"], config.headroom)
        scene, pose, state, info = result
        yield Tracked(scene, pose, state, info, seconds, compile_seconds, plan)


def _reduction(scene: TrackedScene, frame: Frame, config: TrackerConfig) -> int:
    """By how much images shrink for matching, so that the largest object but one fits its template.

    The largest is commonly a robot, which is far larger than what it handles.
    """
    groups = np.asarray(scene.labels[: scene.num_moving])
    means = np.asarray(scene.gaussians.means[: scene.num_moving], np.float64)
    sizes = []
    for viewmat, K in zip(np.asarray(frame.cameras.viewmat), np.asarray(frame.cameras.K), strict=True):
        local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = K[0, 0] * local[:, :2] / np.maximum(local[:, 2:], 1e-3)
        sizes.append([np.ptp(pixels[groups == k], axis=0).max() for k in np.unique(groups)])
    if not sizes or not sizes[0]:
        return 1
    largest = np.sort(np.max(sizes, axis=0))
    size = largest[-2] if len(largest) > 1 else largest[-1]
    return max(1, int(np.ceil(size / config.match.patch)))
