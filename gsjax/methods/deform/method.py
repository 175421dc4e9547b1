"""The method of the drive loop: frames, warm-up, deformation field, moving Gaussians and the graph."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import on_device
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.deform.config import DeformConfig
from gsjax.methods.deform.graph import FrameGraph, frame_graphs
from gsjax.methods.deform.hull import hull_gaussians
from gsjax.methods.deform.meaning import Lesson, counted_ids
from gsjax.methods.deform.nodes import farthest_rows, nodes_of
from gsjax.methods.deform.poses import refined_viewmats, times_of
from gsjax.methods.deform.result import DeformResult, Timeline, timeline_of
from gsjax.methods.deform.start import can_start_from, known_depth, start_gaussians, with_plane_depths
from gsjax.methods.deform.update import Batch, DeformingScene, Moving, deform_step
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.method import Run
from gsjax.optim.step import Step, copied
from gsjax.rasterize.plan import HEADROOM
from gsjax.scene.deformation import init_deformation
from gsjax.scene.frame import Frame, with_black_gaps
from gsjax.scene.gaussians import Gaussians, cull_invalid
from gsjax.scene.initialize import warn_of_hidden
from gsjax.scene.render import plan_render

PLAN = "view"
"""Name in `Run.plans` of the plan that frames are rendered with."""
_OUTSIDE = 0.005  # share of the Gaussians that may lie outside of the field's box at either end of an axis
_GATE_AFTER = 0.25  # share of the joint steps in which all Gaussians may move
_LEAST_EDGE = 0.2  # radii; least extent along an axis, for a flat scene
_MARGIN = 0.05  # of the field's box around the scene, relative to its edges


class Problem(NamedTuple):
    """The constants of a reconstruction.

    Attributes:
        frames: training frames, on the host.
        lesson: the teacher's labels of them; None without a teacher.
        seen: the same frames on the device.
        ids: the teacher's ids where pixels count, on the device; None without a teacher.
        codebook: codebook of the teacher, on the device; None without.
        first: index of the frame that the canonical scene is initialised from; None if from all of them.
        radius: radius of the scene, metres; the unit of learning rates.
        bounds: box of the deformation field, around the initial Gaussians, metres.
        timeline: the frames of the whole recording, for the result.
        background: RGB behind the scene, on the device; None is black.
    """

    frames: Sequence[Frame]
    lesson: Lesson | None
    seen: list[Frame]
    ids: list[Int[Array, "h w"]] | None
    codebook: Float[Array, "k channels"] | None
    first: int | None
    radius: float
    bounds: Float[np.ndarray, "2 3"]
    timeline: Timeline
    background: Float[Array, "1 3"] | None = None


class Kept(NamedTuple):
    """Inputs of the steps that `Deform.between` updates from time to time.

    Attributes:
        moving: where the field is evaluated.
        graphs: graph of each frame; None before they are made, and without a graph.
    """

    moving: Moving = None
    graphs: list[FrameGraph] | None = None


@dataclass(frozen=True)
class Deform:
    """Reconstruction of a deforming scene from one camera (`gsjax.optim.method.Method`): the canonical scene
    alone, then jointly with its deformation.

    Attributes:
        config: configuration of the reconstruction.
        extra_losses: custom losses `loss(scene, rendered, frame)` of a `SceneAtTime`; see
            `gsjax.losses.extra`. `info["extra"]` has their values.
    """

    config: DeformConfig = field(default_factory=DeformConfig)
    extra_losses: ExtraLosses = ()

    def __post_init__(self):
        named_losses(self.extra_losses)

    def start(
        self,
        frames: Sequence[Frame],
        lesson: Lesson | None = None,
        *,
        first: int | None = None,
        gaussians: Gaussians | None = None,
        timeline: Timeline | None = None,
        background: tuple[float, float, float] | None = None,
        hull: bool = False,
    ) -> tuple[Problem, Run]:
        """A reconstruction before its first step.

        Args:
            frames: frames of one camera over time, all of one size, on the host. If none has depth, the scene
                is initialised on a plane.
            lesson: a teacher's labels of these frames, with codes of `config.channels` numbers.
            first: index of the frame from which the canonical scene is initialised (default: the first for
                which `can_start_from` holds).
            gaussians: initial canonical Gaussians; invalid ones are removed (default: from depth, or on the
                plane).
            timeline: frames of the whole recording, for the result (default: `frames`).
            background: RGB behind the scene, 0 to 1 (default: black).
            hull: whether the camera goes around the scene, which is then initialised within its visual hull,
                from all frames alike.

        Raises:
            ValueError: frames differ in size, no pixel counts, no depth is known, the teacher's labels do not
                fit, poses are to be refined but frames share a time, or `first` is given for a hull.
        """
        config = self.config
        _check(frames, config, lesson)
        frames = [with_black_gaps(frame) for frame in frames]
        if hull and first is not None:
            raise ValueError(f"first: expected None, as a hull is of all frames, found {first}")
        if hull:
            if gaussians is None:
                gaussians = hull_gaussians(frames, background, config.hull_points, config.seed)
        elif first is None:
            first = next((i for i, frame in enumerate(frames) if can_start_from(frame, frames)), 0)
        if gaussians is None:
            assert first is not None
            flat = all(frame.depths is None for frame in frames)
            posed = with_plane_depths(frames, first, config.plane_depth) if flat else frames
            gaussians = start_gaussians(posed, first, config.start_pixels)
        scene = _first_scene(gaussians, config, len(frames), lesson is not None)
        means = np.asarray(scene.gaussians.means)
        warn_of_hidden(means, frames)
        middle = np.median(means, axis=0)
        radius = float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9))
        if not radius > 0:
            raise ValueError("depth: expected a scene of some extent, found all of its points in one place")
        low, high = np.quantile(means.astype(np.float64), (_OUTSIDE, 1 - _OUTSIDE), axis=0)
        room = _MARGIN * np.maximum(high - low, _LEAST_EDGE * radius)
        bounds = np.stack([low - room, high + room])
        seen, ids, codebook = [_on_device(frame) for frame in frames], None, None
        if lesson is not None:
            masks = [None if frame.masks is None else frame.masks[0] for frame in frames]
            counted = map(counted_ids, lesson.ids, masks)
            ids = [jnp.asarray(one, jnp.int32) for one in counted]
            codebook = jnp.asarray(lesson.codebook, jnp.result_type(float))
        timeline = timeline_of(frames) if timeline is None else timeline
        behind = None if background is None else jnp.array([background], jnp.result_type(float))
        problem = Problem(frames, lesson, seen, ids, codebook, first, radius, bounds, timeline, behind)
        cameras = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *(frame.cameras for frame in seen))
        plans = {PLAN: plan_render(scene.gaussians, cameras, headroom=HEADROOM)}
        return problem, Run(scene, jax.jit(self.step.init)(scene), plans=plans, kept=Kept())

    @property
    def step(self) -> Step:
        """See `deform_step`."""
        return deform_step(self.config, self.extra_losses)

    def total(self, problem: Problem) -> int:
        """Total number of steps: warm-up steps and joint steps."""
        return self.config.warmup + self.config.iterations

    def period(self, problem: Problem) -> int:
        """Number of frames."""
        return len(problem.seen)

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """Adds the field after the warm-up, selects the Gaussians that keep moving, and makes the graph.
        Arguments as for `Method.between`."""
        config, step = self.config, run.step
        gate, graph = (
            config.warmup + round(share * config.iterations) for share in (_GATE_AFTER, config.graph.after)
        )
        if step >= config.warmup and run.params.field is None:
            scene, moving = with_field(config, problem, run.params)
            run = run.having(params=scene, state=jax.jit(self.step.init)(scene), kept=Kept(moving))
        moving, graphs = run.kept
        # No later, as a field that was added late has moved nothing yet.
        if step == gate and config.moving_share < 1 and moving is None:
            moving = _farthest_moved(run.params, problem.seen, config.moving_share)
        if step >= graph and graphs is None:
            graphs = _graphs(config, problem, run.params, moving)
        return run.having(kept=Kept(moving, graphs))

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[Batch, tuple[str, ...]]:
        """The next frame: the initial one in the warm-up (`config.warmup_frames`); else all in random order,
        shuffled again for each pass. Arguments as for `Method.batch`."""
        i = problem.first if self.config.warmup_frames == "first" else None
        if i is None or run.step >= self.config.warmup:
            i = shuffled_index(self.config.seed, run.step, len(problem.seen))
        return batch_of(problem, run, i, progress), (PLAN,)

    def result(self, problem: Problem, run: Run) -> DeformResult:
        """The scene over time. It shares the arrays of the run, which later steps may donate."""
        scene, meaning = run.params, None if problem.lesson is None else problem.lesson.meaning
        timeline = problem.timeline
        if scene.twists is not None:
            learned = times_of(problem.frames)
            given = timeline.viewmats[:, None]
            found = refined_viewmats(given, timeline.times, scene.twists, learned, problem.radius)
            timeline = timeline._replace(viewmats=found[:, 0])
        still = DeformingScene(scene.gaussians, scene.field)
        return DeformResult(still, run.kept.moving, meaning, timeline)


def batch_of(problem: Problem, run: Run, i: int, progress: float = 0.0) -> Batch:
    """The input of a step on one frame.

    Args:
        problem: from `Deform.start`.
        run: the run before the step.
        i: index of the frame.
        progress: share of the steps that are done, 0 to 1.
    """
    view = None
    if run.params.twists is not None:
        view = jnp.asarray(-1 if i == (problem.first or 0) else i, jnp.int32)
    ids = None if problem.ids is None else problem.ids[i]
    moving, graphs = run.kept
    graph = None if graphs is None else graphs[i]
    given = (problem.codebook, moving, graph, problem.radius, run.plans[PLAN], problem.background)
    return Batch(problem.seen[i], i, progress, view, ids, *given)


def with_field(
    config: DeformConfig, problem: Problem, scene: DeformingScene
) -> tuple[DeformingScene, Moving]:
    """The scene with an initial field, which is the identity, and where the field is evaluated.

    Args:
        config: configuration of the reconstruction.
        problem: from `Deform.start`.
        scene: canonical scene.
    """
    gaussians = scene.gaussians
    size = 0 if gaussians.features is None else gaussians.features.shape[1]
    key = jax.random.fold_in(jax.random.key(config.seed), config.warmup)
    field = init_deformation(key, config.deformation, problem.bounds, size)
    moving = nodes_of(gaussians, config.nodes) if config.nodes else None
    return DeformingScene(gaussians, field, scene.twists), moving


def _farthest_moved(scene: DeformingScene, frames: Sequence[Frame], share: float) -> Int[Array, "M"]:
    """Rows of the share of the Gaussians with the largest displacement in any frame."""
    at = jax.jit(lambda scene, time: jnp.linalg.norm(scene.at(time).means - scene.gaussians.means, axis=-1))
    farthest = np.max([np.asarray(at(scene, frame.time)) for frame in frames], axis=0)
    order = np.argsort(-farthest, kind="stable")
    return jnp.asarray(np.sort(order[: max(1, round(share * len(farthest)))]), jnp.int32)


def _on_device(frame: Frame) -> Frame:
    """A frame of one camera on the device, with depth where it is known and counts, and always with a mask
    and a time, so that one program is compiled for all."""
    dtype = jnp.result_type(float)
    masks = np.ones(frame.images.shape[:3], bool) if frame.masks is None else frame.masks
    depths = None if frame.depths is None else jnp.asarray(known_depth(frame), dtype)[None]
    time = jnp.asarray(0.0 if frame.time is None else frame.time, dtype)
    return Frame(jnp.asarray(frame.images), depths, on_device(frame.cameras), jnp.asarray(masks), time)


def _graphs(
    config: DeformConfig, problem: Problem, scene: DeformingScene, moving: Moving
) -> list[FrameGraph] | None:
    """The graph of each frame, from the current positions of the nodes and the current poses."""
    if config.graph.kind == "none" or problem.lesson is None:
        return None
    nodes = farthest_rows(scene.gaussians.means, config.graph.nodes)
    at = jax.jit(lambda scene, time: scene.at(time, moving).means[nodes])
    places = np.stack([np.asarray(at(scene, frame.time)) for frame in problem.seen])
    frames, (ids, codebook, _) = problem.frames, problem.lesson
    if scene.twists is not None:
        given, times = np.stack([frame.cameras.viewmat for frame in frames]), times_of(frames)
        refined = refined_viewmats(given, times, scene.twists, times, problem.radius)
        pairs = zip(frames, refined, strict=True)
        frames = [eqx.tree_at(lambda f: f.cameras.viewmat, frame, viewmat) for frame, viewmat in pairs]
    return frame_graphs(places, nodes, frames, ids, codebook, config.graph, problem.radius)


def _first_scene(
    gaussians: Gaussians, config: DeformConfig, frames: int, has_teacher: bool
) -> DeformingScene:
    """The scene of copies of the valid Gaussians, with zero features and twists."""
    gaussians, _ = cull_invalid(gaussians)
    if not gaussians.num:
        raise ValueError("gaussians: expected at least one that is valid, found none")
    twists = jnp.zeros((frames, 6)) if config.refine_poses else None
    scene = DeformingScene(copied(gaussians), None, twists)
    if not has_teacher:
        return scene
    features = jnp.zeros((gaussians.num, config.channels))
    return eqx.tree_at(lambda s: s.gaussians.features, scene, features, is_leaf=lambda leaf: leaf is None)


def _check(frames: Sequence[Frame], config: DeformConfig, lesson: Lesson | None) -> None:
    if not frames:
        raise ValueError("frames: expected at least one, found none")
    shape = frames[0].images.shape
    for i, frame in enumerate(frames):
        if frame.images.shape != shape or len(frame.images) != 1:
            raise ValueError(
                f"frames: expected one image {shape[1:]} like the first, found {frame.images.shape} in frame "
                f"{i}"
            )
        for name in ("masks", "depths"):
            value = getattr(frame, name)
            if value is not None and value.shape != shape[:3]:
                raise ValueError(
                    f"frames: expected {name} {shape[:3]} to match images, found {value.shape} in frame {i}"
                )
    if not any(frame.masks is None or frame.masks.any() for frame in frames):
        raise ValueError(
            "masks: expected pixels that count, found none in any frame; are the masks inverted?"
        )
    times = times_of(frames).tolist()
    if config.refine_poses and len(set(times)) < len(times):
        raise ValueError(
            f"refine_poses: expected frames at different times, between which poses are interpolated, found "
            f"{len(times)} at {len(set(times))} times; turn it off"
        )
    if lesson is None:
        return
    if len(lesson.ids) != len(frames):
        raise ValueError(f"lesson: expected ids of {len(frames)} frames, found {len(lesson.ids)}")
    for i, ids in enumerate(lesson.ids):
        if ids.max(initial=-1) >= len(lesson.codebook):
            raise ValueError(
                f"lesson: expected ids below {len(lesson.codebook)}, the number of rows of the codebook, "
                f"found {ids.max()} in frame {i}"
            )
    if lesson.codebook.shape[1] != config.channels:
        raise ValueError(
            f"codebook: expected rows of {config.channels} numbers, found {lesson.codebook.shape[1]}"
        )
