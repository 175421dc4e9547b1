"""The host's side of tracking: compile once, feed frames, re-plan when a plan has become too small."""

import itertools
import time
import warnings
from collections.abc import Iterable, Iterator
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.track.budget import Chosen, Costs, Governor, choose, ladder
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.first_fit import fit_scene
from gsjax.methods.track.grow import empty_slots, grow, with_slots
from gsjax.methods.track.motion import Pose, first_pose, place
from gsjax.methods.track.plan import TrackPlan, plan_tracker
from gsjax.methods.track.region import shift_background
from gsjax.methods.track.scene import TrackedScene, labelled_cloud, scene_from_cloud
from gsjax.methods.track.update import TrackBatch, TrackState, track_step
from gsjax.optim.compiler import host_options
from gsjax.optim.step import keep_if
from gsjax.scene.frame import Frame, part_of, without_broken
from gsjax.scene.gaussians import Gaussians

_TRIALS = 5  # updates whose median says what one costs


class Tracked(NamedTuple):
    """The scene after one frame.

    Attributes:
        scene: the scene, with slots for what joins objects and what has joined so far.
        pose: where the moving Gaussians are now.
        state: what the tracker carries to the next frame.
        info: losses and matches by name; see `track_step`.
        seconds: from images in memory to the new state, re-planning included; compilation apart.
        compile_seconds: what compiling took before that; 0 but for the first frame and after re-plans.
        plan: the plan it ran under.
        everywhere: how many groups it looked for everywhere.
        chosen: the settings that were chosen for a budget; None without one.
    """

    scene: TrackedScene
    pose: Pose
    state: TrackState
    info: dict[str, Any]
    seconds: float
    compile_seconds: float
    plan: TrackPlan
    everywhere: int
    chosen: Chosen | None = None

    def gaussians(self) -> Gaussians:
        """The whole scene as it stands now."""
        return place(self.scene, self.pose)


def start_scene(
    frame: Frame, mask: np.ndarray, mask_camera: int = 0, config: TrackConfig | None = None
) -> TrackedScene:
    """A labelled, photometrically optimised scene from the first RGB-D frame and one camera's mask.

    Args:
        frame: what the cameras see at first, with depth.
        mask: labels [H, W] of one camera's image; 0 is background.
        mask_camera: which camera of the frame the mask belongs to, counted from 0.

    Raises:
        ValueError: there is no depth, or the mask does not fit the images.
    """
    config = TrackConfig() if config is None else config
    frame, broken = without_broken(frame)
    if broken:
        warnings.warn(f"the first frame has {broken} pixels that are not finite; unused", stacklevel=2)
    scene = scene_from_cloud(labelled_cloud(frame, mask, mask_camera, config.start), config.start)
    return fit_scene(scene, frame, config.start.iterations, config.headroom)[0]


@partial(jax.jit, static_argnames=("config", "num_objects"))
def _first_state(pose, batch, config: TrackConfig, num_objects: int):
    return track_step(config, num_objects, batch).init(pose)


def first_state(
    scene: TrackedScene, pose: Pose, first: Frame, config: TrackConfig, plan: TrackPlan | None = None
) -> TrackState:
    """What the first frame leaves behind, for `pose`, which it shows; planned here unless it has been."""
    first, _ = without_broken(part_of(first, config.cameras, config.shrink))
    plan = plan_tracker(scene, pose, first, config) if plan is None else plan
    return _first_state(pose, TrackBatch(scene, first, plan), config, scene.num_objects)


@partial(jax.jit, static_argnames=("config", "num_objects", "reduction", "extra_losses"))
def _update(
    pose,
    state,
    batch,
    step,
    config: TrackConfig,
    num_objects: int,
    reduction: int,
    extra_losses: ExtraLosses,
):
    frame, broken = without_broken(part_of(batch.frame, config.cameras, config.shrink))
    batch = batch._replace(frame=frame)
    tracker = track_step(config, num_objects, batch, reduction, extra_losses)
    with jax.default_matmul_precision("highest"):  # poses compound: no TF32 on GPUs that have it
        pose, state, info = tracker.update(pose, state, batch, step=step, key=None)
    shown, background, scene = info.pop("shown"), info.pop("background"), batch.scene
    if background is not None:
        scene = keep_if(~info["skipped"], shift_background(scene, background), scene)
    info |= {"broken_pixels": broken, "joined": jnp.int32(0)}
    if config.grow.slots and frame.depths is not None:
        how = (config.grow, config.coarseness, info["lost"])
        grown = grow(scene, pose, shown, frame, state.count, *how)
        scene, pose = keep_if(~info["skipped"], grown, (scene, pose))
        info["joined"] = config.grow.slots - empty_slots(scene).sum()
    return scene, pose, state, info


@lru_cache(maxsize=8)
def _compiled_update(treedef, shapes, **static):
    """`_update` for arguments of this form; kept, so that a second sequence like the first starts at once."""
    return _update.lower(*jax.tree.unflatten(treedef, shapes), **static).compile(host_options())


def _signature(arguments):
    """What a compiled program is made for: the tree, the plan in it, and each leaf's shape and dtype."""
    leaves, treedef = jax.tree.flatten(arguments)
    return treedef, tuple(map(jax.typeof, leaves))


def track(
    scene: TrackedScene,
    first: Frame,
    frames: Iterable[Frame],
    config: TrackConfig | None = None,
    *,
    budget_ms: float | None = None,
    after: Tracked | None = None,
    extra_losses: ExtraLosses = (),
) -> Iterator[Tracked]:
    """Follow the objects of `scene` through `frames` (those after the first one), one `Tracked` a frame.

    Nothing is compiled between frames, unless a plan overflows: then the frame is done again under the next
    rung, from the state before it, so nothing is lost.

    Args:
        scene: from `start_scene` or `scene_from_shapes`.
        first: the frame that `scene` shows; with `after`, the frame that it shows.
        frames: the frames after it, in order of time; all of one size and number of cameras.
        config: see `TrackConfig`.
        budget_ms: what an update may take, milliseconds. The richest settings that keep to it are then chosen
            by measured cost, and of `config` only what says how a scene starts is used (see `budget`).
        after: the update to go on from, with its scene, state and settings; the first frame unless given.
        extra_losses: functions `loss(scene, rendered, frame)` of one's own beside the refinement's loss; see
            `track_step`.

    Raises:
        ValueError: a frame has other shapes than the first one, the budget is not above 0, or there are extra
            losses and no refinement to add them to.
    """
    config = TrackConfig() if config is None else config
    if budget_ms is not None and not budget_ms > 0:
        raise ValueError(f"budget_ms: expected milliseconds above 0, found {budget_ms}")
    named_losses(extra_losses)  # before it is a key, which a list cannot be
    if budget_ms is not None and extra_losses:
        raise ValueError(
            "extra_losses: expected none under budget_ms, whose settings have no refinement to add them to; "
            "leave one of the two out"
        )
    chosen = None
    if after is not None:
        scene, pose, chosen = after.scene, after.pose, after.chosen
    else:
        if config.grow.slots and first.depths is not None:
            scene = with_slots(scene, config.grow.slots)
        pose = first_pose(scene)
    count, governor = scene.num_objects, None
    if budget_ms is not None:
        if chosen is None:
            frames = iter(frames)
            ahead = list(itertools.islice(frames, 1))
            frames = itertools.chain(ahead, frames)
            second = [*ahead, first][0]
            _check_alike(second, first, 1)
            measure = partial(_measured, scene, pose, first, second)
            chosen = choose(ladder(config, len(first.images)), measure, budget_ms / 1e3, count)
        config, governor = chosen.config, Governor(budget_ms / 1e3, chosen.costs, count)
    run = _Runner(scene, pose, first, config, extra_losses)
    state = first_state(scene, pose, first, config, run.plan) if after is None else after.state
    usually = count if config.align.everywhere is None else min(config.align.everywhere, count)
    for index, frame in enumerate(frames):
        _check_alike(frame, first, index + 1)
        jax.block_until_ready(frame)
        everywhere = usually if governor is None else governor.allowed()
        (scene, pose, state, info), seconds, compile_seconds = run(
            scene, pose, state, frame, index, everywhere
        )
        looked_for = int(info["looked_for"].sum())
        if governor is not None:
            governor.spent(seconds, looked_for)
        yield Tracked(scene, pose, state, info, seconds, compile_seconds, run.plan, looked_for, chosen)


class _Runner:
    """The compiled update of one configuration, compiled again where a plan has become too small."""

    def __init__(
        self,
        scene: TrackedScene,
        pose: Pose,
        first: Frame,
        config: TrackConfig,
        extra_losses: ExtraLosses = (),
    ):
        first, _ = without_broken(part_of(first, config.cameras, config.shrink))
        self.plan = plan_tracker(scene, pose, first, config)
        self._config = config
        reduction = _reduction(scene, first, config)
        self._static = {
            "config": config,
            "num_objects": scene.num_objects,
            "reduction": reduction,
            "extra_losses": extra_losses,
        }
        self._compiled: dict[TrackPlan, Any] = {}

    def __call__(self, scene, pose, state, frame: Frame, index: int, everywhere: int):
        """What `_update` gives, the seconds that it took, and those of compiling."""
        seconds = compile_seconds = 0.0
        while True:
            batch = TrackBatch(scene, frame, self.plan, jnp.int32(everywhere))
            arguments = (pose, state, batch, index)
            if self.plan not in self._compiled:
                begun = time.perf_counter()
                self._compiled[self.plan] = _compiled_update(*_signature(arguments), **self._static)
                compile_seconds += time.perf_counter() - begun
            begun = time.perf_counter()
            result = jax.block_until_ready(self._compiled[self.plan](*arguments))
            seconds += time.perf_counter() - begun
            info = result[3]
            if not bool(info["overflow"]):
                return result, seconds, compile_seconds
            self.plan = self.plan.grown(info["needed"], self._config.headroom)


def _measured(scene: TrackedScene, pose: Pose, first: Frame, second: Frame, config: TrackConfig) -> Costs:
    """What updates cost: those to the second frame, which shows the background anew where cameras move."""
    run, count = _Runner(scene, pose, first, config), scene.num_objects
    state = first_state(scene, pose, first, config, run.plan)

    def median(everywhere: int) -> tuple[float, int]:
        """Seconds, and how many groups there were to look for."""
        trials = [run(scene, pose, state, second, 0, everywhere) for _ in range(_TRIALS)]
        return float(np.median([trial[1] for trial in trials])), int(trials[0][0][3]["looked_for"].sum())

    median(0)  # the first calls fault their memory in
    base, (all_of_them, looked_for) = median(0)[0], median(count)
    return Costs(base, max(all_of_them - base, 0.0) / max(looked_for, 1))


def _check_alike(frame: Frame, first: Frame, index: int) -> None:
    for name in ("images", "depths"):
        found, wanted = getattr(frame, name), getattr(first, name)
        found, wanted = (None if a is None else a.shape for a in (found, wanted))
        if found != wanted:
            raise ValueError(
                f"frames: number {index} after the first has {name} of shape {found}, expected {wanted} as "
                "in the first; give all frames one size and the same cameras"
            )


def _reduction(scene: TrackedScene, frame: Frame, config: TrackConfig) -> int:
    """By how much images shrink for matching, so that the largest object but one fits its template.

    The largest is commonly a robot, which is far larger than what it handles.
    """
    groups = np.asarray(scene.labels[: scene.num_moving])
    means = np.asarray(scene.gaussians.means[: scene.num_moving], np.float64)
    sizes = []
    for viewmat, K in zip(np.asarray(frame.cameras.viewmat), np.asarray(frame.cameras.K), strict=True):
        local = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = K[0, 0] * local[:, :2] / np.maximum(local[:, 2:], 1e-3)
        there = [k for k in range(1, scene.num_objects + 1) if (groups == k).any()]  # no empty slots
        sizes.append([np.ptp(pixels[groups == k], axis=0).max() for k in there])
    largest = np.sort(np.max(sizes, axis=0))
    size = largest[-2] if len(largest) > 1 else largest[-1]
    return max(1, int(np.ceil(size / config.match.patch)))
