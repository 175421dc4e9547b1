"""A discovery as one value: which frame is next, when parts become one or two, and what comes last."""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Start
from gsjax.methods.parts.discovery import (
    Discovery,
    closed,
    first_run,
    opened,
    order_of_frames,
    weights_of_run,
)
from gsjax.methods.parts.finish import finished, outcome
from gsjax.methods.parts.pictures import (
    HALF,
    WHOLE,
    Problem,
    draws_of,
    frame_now,
    order_of_pictures,
    picture_then,
    problem_of,
    whole_picture,
)
from gsjax.methods.parts.refine import RefineBatch, RefineParams
from gsjax.methods.parts.result import PartsResult
from gsjax.methods.parts.stream import StreamBatch, posed
from gsjax.methods.parts.update import parts_step
from gsjax.methods.protocols import SequenceLike
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render

_PLANS = {HALF: "half", WHOLE: "whole"}
_REFINING = "refining"  # the plan of the steps over all frames, which draw the whole of a picture


@dataclass(frozen=True)
class Parts:
    """Parts of a moving scene (`gsjax.optim.method.Method`): frame after frame, away from the anchor, and in
    the end all frames together.

    Attributes:
        config: how parts are found and followed.
        extra_losses: custom losses `loss(scene, rendered, frame)`, whose scene is a `PosedScene`; see
            `gsjax.losses.extra`. `info["extra"]` has their values.
    """

    config: PartsConfig = field(default_factory=PartsConfig)
    extra_losses: ExtraLosses = ()

    def __post_init__(self):
        named_losses(self.extra_losses)

    def start(self, sequence: SequenceLike, start: Start) -> tuple[Problem, Run]:
        """A discovery before its first step.

        Args:
            sequence: what synchronised cameras saw.
            start: from `begin`.
        """
        return problem_of(sequence), first_run(start, sequence.num_frames, self.config)

    @property
    def step(self) -> Step:
        """See `parts_step`."""
        return parts_step(self.config, self.extra_losses)

    def steps_of_frames(self, problem: Problem) -> int:
        """How many steps find the poses of all frames; those over all frames together come after."""
        return (problem.sequence.num_frames - 1) * self.config.stream.iterations

    def total(self, problem: Problem) -> int:
        """The steps of all frames, and those over all frames together."""
        return self.steps_of_frames(problem) + self.config.refine.iterations

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """Keeps the pose of a frame whose last step was made, makes parts one or two, and opens the next
        frame; after the last one leaves out parts that no picture needs, and begins to refine the scene.

        Args:
            problem, run, progress: as in `gsjax.optim.method.Method`; progress is not used.
        """
        run = self.brought_up_to_date(problem, run)
        if not isinstance(run.params, RefineParams):
            discovery: Discovery = run.kept
            if discovery.is_between_frames:
                order = order_of_frames(problem.sequence.num_frames, discovery.anchor)
                run = opened(run, order[discovery.count])
        return run.having(plans=run.plans | self._missing_plans(problem, run))

    def brought_up_to_date(self, problem: Problem, run: Run) -> Run:
        """The run with all that follows from the steps that were made: the pose of the frame whose last step
        was made is kept, and after the last frame no part is left that no picture needs."""
        if isinstance(run.params, RefineParams):
            return run
        discovery: Discovery = run.kept
        if not discovery.is_between_frames and self._step_of_frame(run) == self.config.stream.iterations:
            run = closed(run, self.config)
        if run.kept.done.all():
            run = finished(problem.sequence, run, self.config)
        return run

    def batch(
        self, problem: Problem, run: Run, progress: float
    ) -> tuple[StreamBatch | RefineBatch, tuple[str, ...]]:
        """One camera of the frame that is being found and pictures of the past; or any picture.

        Args:
            problem, run, progress: as in `gsjax.optim.method.Method`; progress is not used.
        """
        if isinstance(run.params, RefineParams):
            return self._batch_of_all(problem, run)
        config, discovery = self.config.stream, run.kept
        canonical, i, size = discovery.canonical, self._step_of_frame(run), self._size(run)
        past = np.flatnonzero(discovery.found >= discovery.born[np.asarray(canonical.alive)].max())
        past = tuple(past.tolist()) or (int(discovery.found.argmax()),)
        cameras = problem.sequence.num_cameras
        drawn = draws_of(self.config.seed, discovery.frame, cameras, past, config.past, config.iterations)
        frame = one_camera(frame_now(problem, discovery, size, config.blend), drawn.cameras[i])
        batch = StreamBatch(
            canonical, frame, i / config.iterations, run.plans[_PLANS[size]], discovery.weights
        )
        if not drawn.past[i]:
            return batch, (_PLANS[size],)
        then = tuple(picture_then(problem, discovery, t, c, config.blend) for t, c in drawn.past[i])
        batch = batch._replace(past=then, past_plan=run.plans[_PLANS[HALF]])
        return batch, (_PLANS[size], _PLANS[HALF])

    def result(self, problem: Problem, run: Run) -> PartsResult:
        """The scene with the parts that were found so far; a frame whose steps are not all made is left
        out."""
        run = self.brought_up_to_date(problem, run)
        discovery: Discovery = run.kept
        if isinstance(run.params, RefineParams):
            movable, fixed, poses = run.params
            discovery = discovery._replace(
                canonical=discovery.canonical._replace(movable=movable, fixed=fixed),
                quats=np.asarray(poses.quats),
                translations=np.asarray(poses.translations),
            )
        settled = isinstance(run.params, RefineParams) or not discovery.is_between_frames
        weights = np.asarray(discovery.weights if settled else weights_of_run(run))
        scene, trajectory = outcome(discovery, weights, problem.sequence.times)
        return PartsResult(
            scene,
            trajectory,
            discovery.done,
            discovery.anchor,
            float(discovery.canonical.pixel),
            self.config.stream.blend,
        )

    def _step_of_frame(self, run: Run) -> int:
        """How many steps of its frame a run has made."""
        return run.step - run.kept.count * self.config.stream.iterations

    def _size(self, run: Run) -> int:
        """The size of the pictures of this frame that the next step sees."""
        stream = self.config.stream
        return HALF if self._step_of_frame(run) < stream.coarse * stream.iterations else WHOLE

    def _batch_of_all(self, problem: Problem, run: Run) -> tuple[RefineBatch, tuple[str, ...]]:
        """A picture of any frame, for the steps over all frames together."""
        discovery: Discovery = run.kept
        i = run.step - self.steps_of_frames(problem)
        t, camera = self._order_of_all(problem, discovery)[i]
        batch = RefineBatch(
            discovery.canonical,
            discovery.weights,
            whole_picture(problem, t, camera),
            jnp.asarray(t),
            jnp.asarray(discovery.anchor),
            i / self.config.refine.iterations,
            run.plans[_REFINING],
        )
        return batch, (_REFINING,)

    def _order_of_all(self, problem: Problem, discovery: Discovery) -> list[tuple[int, int]]:
        frames = tuple(np.flatnonzero(discovery.done).tolist())
        cameras, steps = problem.sequence.num_cameras, self.config.refine.iterations
        return order_of_pictures(self.config.seed, frames, cameras, steps)

    def _missing_plans(self, problem: Problem, run: Run) -> dict[str, Plan]:
        """Plans for what is drawn for the first time."""
        discovery: Discovery = run.kept
        if isinstance(run.params, RefineParams):
            if _REFINING in run.plans or not self.config.refine.iterations:
                return {}
            t, _ = self._order_of_all(problem, discovery)[0]
            scene, cameras = self._posed(discovery, t), problem.sequence.frame(t).cameras
            return {_REFINING: plan_render(scene, cameras, headroom=self.config.headroom)}
        stream, plans = self.config.stream, {}
        for size in {self._size(run), HALF} if stream.past else {self._size(run)}:
            if _PLANS[size] not in run.plans:
                scene = self._posed(discovery, int(discovery.found.argmax()))
                cameras = frame_now(problem, discovery, size, stream.blend).cameras
                plans[_PLANS[size]] = plan_render(scene, cameras, headroom=self.config.headroom)
        return plans

    def _posed(self, discovery: Discovery, t: int) -> Gaussians:
        return posed(discovery.canonical, discovery.weights, discovery.pose(t))
