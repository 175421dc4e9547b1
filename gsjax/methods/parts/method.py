"""The parts method: the order of frames, when parts are joined or divided, and the final refinement."""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np

from gsjax.geometry.cameras import on_device, resized
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.parts.absence import with_absences
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Start
from gsjax.methods.parts.discovery import (
    Discovery,
    close_frame,
    initial_run,
    open_frame,
    order_of_frames,
    weights_of_run,
    with_prediction,
)
from gsjax.methods.parts.finish import begin_refinement, scene_and_trajectory
from gsjax.methods.parts.pictures import (
    Problem,
    any_picture,
    coarse_frame,
    current_frame,
    draws_of,
    order_of_pictures,
    past_picture,
    stored_frame,
)
from gsjax.methods.parts.refine import RefineBatch, RefineParams, parts_step
from gsjax.methods.parts.result import PartsResult
from gsjax.methods.parts.search import searched
from gsjax.methods.parts.sizes import COARSE, FINE
from gsjax.methods.parts.stream import StreamBatch, posed
from gsjax.methods.protocols import SequenceLike
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.plan import Plan
from gsjax.scene.frame import one_camera
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render

_LEAST_STEPS, _PASSES = 400, 2  # of the refinement, by default; passes over all pictures
_SHARE_OF_SMALLER = 0.5  # share of the refinement with pictures no larger than those of tracking


@dataclass(frozen=True)
class Parts:
    """The parts method (`gsjax.optim.method.Method`): tracks parts frame by frame, away from the anchor, and
    then refines all frames together.

    Attributes:
        config: settings.
        extra_losses: custom losses `loss(scene, rendered, frame)`, whose scene is a `PosedScene`; see
            `gsjax.losses.extra`. `info["extra"]` has their values.
    """

    config: PartsConfig = field(default_factory=PartsConfig)
    extra_losses: ExtraLosses = ()

    def __post_init__(self):
        named_losses(self.extra_losses)

    def start(self, sequence: SequenceLike, start: Start) -> tuple[Problem, Run]:
        """The problem and the run before the first step.

        Args:
            sequence: the recording of synchronised cameras.
            start: from `begin`.
        """
        problem = Problem(sequence, at_once=start.motions is not None)
        return problem, initial_run(start, sequence.num_frames, self.config)

    @property
    def step(self) -> Step:
        """See `parts_step`."""
        return parts_step(self.config, self.extra_losses)

    def steps_of_frames(self, problem: Problem) -> int:
        """Number of steps that find the poses of all frames, before the refinement."""
        frames = 0 if problem.at_once else problem.sequence.num_frames - 1
        return frames * self.config.stream.iterations

    def steps_of_refinement(self, problem: Problem) -> int:
        """Number of steps of the refinement over all frames."""
        asked, sequence = self.config.refine.iterations, problem.sequence
        if asked is not None:
            return asked
        return max(_LEAST_STEPS, _PASSES * sequence.num_frames * sequence.num_cameras)

    def total(self, problem: Problem) -> int:
        """Number of steps, with the refinement."""
        return self.steps_of_frames(problem) + self.steps_of_refinement(problem)

    def period(self, problem: Problem) -> int:
        """1, as pictures are drawn anew for each step."""
        return 1

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """Stores the pose of a finished frame, joins and divides parts, and opens the next frame; after the
        last frame, removes parts that no picture needs and begins the refinement.
        Arguments as for `Method.between`; progress is not used."""
        run = self.brought_up_to_date(problem, run)
        discovery: Discovery = run.kept
        if not isinstance(run.params, RefineParams) and discovery.is_between_frames:
            order = order_of_frames(problem.sequence.num_frames, discovery.anchor)
            run = self._opened(problem, run, order[discovery.count])
        elif self._size(problem, run) != self._size(problem, run.having(step=run.step - 1)):
            run = run.having(guard=None)  # losses at another size are not comparable
        return run.having(plans=run.plans | self._missing_plans(problem, run))

    def brought_up_to_date(self, problem: Problem, run: Run) -> Run:
        """The run after everything that follows its last step: the pose of a finished frame is stored, and
        after the last frame, parts that no picture needs are removed."""
        if isinstance(run.params, RefineParams):
            return run
        discovery: Discovery = run.kept
        if not discovery.is_between_frames and self._step_of_frame(run) == self.config.stream.iterations:
            run = close_frame(run, self.config)
        if run.kept.done.all():
            run = begin_refinement(problem, run, self.config)
        return run

    def batch(
        self, problem: Problem, run: Run, progress: float
    ) -> tuple[StreamBatch | RefineBatch, tuple[str, ...]]:
        """One camera of the current frame and pictures of the past; in the refinement, any picture.
        Arguments as for `Method.batch`; progress is not used."""
        if isinstance(run.params, RefineParams):
            return self._batch_of_all(problem, run)
        config, discovery = self.config.stream, run.kept
        canonical, i, size = discovery.canonical, self._step_of_frame(run), self._size(problem, run)
        past = np.flatnonzero(discovery.found >= discovery.born[np.asarray(canonical.alive)].max())
        past = tuple(past.tolist()) or (int(discovery.found.argmax()),)
        cameras = problem.sequence.num_cameras
        drawn = draws_of(self.config.seed, discovery.frame, cameras, past, config.past, config.iterations)
        t, c = discovery.frame, drawn.cameras[i]
        frame = one_camera(current_frame(problem, discovery, size, config.blend), c)
        plan = run.plans[size]
        batch = StreamBatch(canonical, frame, t, c, i / config.iterations, plan, discovery.weights)
        if not drawn.past[i]:
            return batch, (size,)
        then = tuple(past_picture(problem, discovery, t, c, config.blend) for t, c in drawn.past[i])
        batch = batch._replace(past=then, past_plan=run.plans[COARSE])
        return batch, (size, COARSE)

    def result(self, problem: Problem, run: Run) -> PartsResult:
        """The scene with the parts found so far, without an unfinished frame."""
        run = self.brought_up_to_date(problem, run)
        discovery: Discovery = run.kept
        if isinstance(run.params, RefineParams):
            movable, fixed, poses = run.params
            discovery = discovery._replace(
                canonical=discovery.canonical._replace(movable=movable, fixed=fixed),
                quats=np.asarray(poses.quats),
                translations=np.asarray(poses.translations),
            )
            if discovery.absent is not None:
                discovery = with_absences(discovery, discovery.absent)
        settled = isinstance(run.params, RefineParams) or not discovery.is_between_frames
        weights = np.asarray(discovery.weights if settled else weights_of_run(run))
        scene, trajectory = scene_and_trajectory(discovery, weights, problem.sequence.times)
        pixel, blend = float(discovery.canonical.pixel), self.config.stream.blend
        return PartsResult(scene, trajectory, discovery.done, discovery.anchor, pixel, blend)

    def _opened(self, problem: Problem, run: Run, t: int) -> Run:
        """The run before the first step of frame t, after a search for parts that jumped."""
        run = open_frame(run, t)
        discovery: Discovery = run.kept
        if not self.config.stream.search:
            return run
        anchor, now = (coarse_frame(problem, discovery, at) for at in (discovery.anchor, t))
        return with_prediction(run, searched(discovery, now, anchor, self.config.stream.blend))

    def _step_of_frame(self, run: Run) -> int:
        """Number of steps that a run has made in its frame."""
        return run.step - run.kept.count * self.config.stream.iterations

    def _size(self, problem: Problem, run: Run) -> str:
        """The size of the pictures in the next step, by the name of its plan."""
        if isinstance(run.params, RefineParams):
            return f"refining 1/{self._shrink(problem, run)}"
        stream = self.config.stream
        return COARSE if self._step_of_frame(run) < stream.coarse * stream.iterations else FINE

    def _batch_of_all(self, problem: Problem, run: Run) -> tuple[RefineBatch, tuple[str, ...]]:
        """A picture of any frame, for the refinement."""
        discovery: Discovery = run.kept
        i = run.step - self.steps_of_frames(problem)
        t, camera = self._order_of_all(problem, discovery)[i]
        plan = self._size(problem, run)
        batch = RefineBatch(
            discovery.canonical,
            discovery.weights,
            any_picture(problem, discovery, t, camera, self._shrink(problem, run)),
            jnp.asarray(t),
            jnp.asarray(camera),
            jnp.asarray(discovery.anchor),
            i / self.steps_of_refinement(problem),
            run.plans[plan],
            problem.at_once,  # measured surfaces determine poses better than pictures do
            None if discovery.absent is None else jnp.asarray(~discovery.absent[t], jnp.float32),
        )
        return batch, (plan,)

    def _shrink(self, problem: Problem, run: Run) -> int:
        """The factor by which the pictures of the refinement's next step are smaller than in the data."""
        done = run.step - self.steps_of_frames(problem)
        if done >= _SHARE_OF_SMALLER * self.steps_of_refinement(problem):
            return 1
        return problem.coarse_factor // 2

    def _order_of_all(self, problem: Problem, discovery: Discovery) -> list[tuple[int, int]]:
        frames = tuple(np.flatnonzero(discovery.done).tolist())
        cameras, steps = problem.sequence.num_cameras, self.steps_of_refinement(problem)
        return order_of_pictures(self.config.seed, frames, cameras, steps)

    def _missing_plans(self, problem: Problem, run: Run) -> dict[str, Plan]:
        """Plans for what is rendered for the first time."""
        discovery: Discovery = run.kept
        if isinstance(run.params, RefineParams):
            size = self._size(problem, run)
            if size in run.plans or run.step >= self.total(problem):
                return {}
            cameras, shrink = stored_frame(problem, discovery.anchor).cameras, self._shrink(problem, run)
            cameras = resized(cameras, 1 / shrink, cameras.width // shrink, cameras.height // shrink)
            scene = self._posed(discovery, discovery.anchor)
            return {size: plan_render(scene, on_device(cameras), headroom=self.config.headroom)}
        stream, plans = self.config.stream, {}
        for size in {self._size(problem, run), COARSE} if stream.past else {self._size(problem, run)}:
            if size not in run.plans:
                scene = self._posed(discovery, int(discovery.found.argmax()))
                cameras = current_frame(problem, discovery, size, stream.blend).cameras
                plans[size] = plan_render(scene, cameras, headroom=self.config.headroom)
        return plans

    def _posed(self, discovery: Discovery, t: int) -> Gaussians:
        return posed(discovery.canonical, discovery.weights, discovery.pose(t))
