"""Update rate of each method's step. To add a method, add a function to `STEPS`."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.floors import Floors, is_calm, measure_floors
from benchmarks.metrics import Metric
from benchmarks.timing import compile_program, median_and_p95, sample
from benchmarks.workloads import ball
from gsjax.data import open_sequence
from gsjax.engine.drive import Tick, drive
from gsjax.engine.track.tracking import track
from gsjax.engine.verbs import deform as deform_steps
from gsjax.geometry.cameras import Camera
from gsjax.losses.photometric import photometric_loss
from gsjax.methods.deform import DeformConfig, GraphConfig
from gsjax.methods.distill import Distill, DistillConfig, teacher_of_objects
from gsjax.methods.track import PRESETS, start_scene
from gsjax.optim.compiler import host_options
from gsjax.optim.step import gradient_step, per_field_adam
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render

TABLE = "simulated:tabletop?width=240&height=180&frames={}"
TISSUE = "simulated:tissue?width=160&height=128&frames=6"
FIT_GAUSSIANS, FIT_SIZE = 10_000, (320, 240)
RATES = {"means": 1e-4, "quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 2e-2, "sh0": 5e-3}


@dataclass(frozen=True)
class StepTimes:
    """Seconds of each update of a method after the first, and of compilation."""

    what: str
    seconds: list[float]
    compile_s: float


def tracker(repeats: int, preset: str = "accurate") -> StepTimes:
    """The object tracker's update, on a new frame every time, as in use."""
    sequence = open_sequence(TABLE.format(repeats + 2)).select(cameras=(0, 1))
    frames = [sequence.frame(t) for t in range(sequence.num_frames)]
    config = PRESETS[preset]
    # Fitting the first frame takes long and is not timed.
    config = replace(config, start=replace(config.start, iterations=20))
    scene = start_scene(frames[0], sequence.mask(0, 0), 0, config)
    updates = list(islice(track(scene, frames[0], frames[1:], config), repeats + 1))
    what = f"{scene.gaussians.num} Gaussians, 2 cameras of {sequence.width}x{sequence.height}"
    compiling = sum(update.compile_seconds for update in updates)
    return StepTimes(what, [update.seconds for update in updates[1:]], compiling)


def fit(repeats: int) -> StepTimes:
    """One step of Adam on L1 and D-SSIM against one image; each call continues from the previous one."""
    width, height = FIT_SIZE
    seen, start = ball(FIT_GAUSSIANS, width, height), ball(FIT_GAUSSIANS, width, height, seed=1)
    camera = Camera(seen.viewmat[None], seen.K[None], width, height)
    goal, params = (gaussians_from_activated(*scene[:5]) for scene in (seen, start))
    plan = plan_render(params, camera, headroom=2.0)
    target = render(goal, camera).colors
    step = gradient_step(partial(_loss, plan=plan, camera=camera), per_field_adam(RATES))
    state = step.init(params)

    def update(params, state, target, i):
        return step.update(params, state, target, step=i, key=None)

    compiled = compile_program(update, params, state, target, jnp.int32(0), options=host_options())
    held: list[Any] = [params, state]

    def call(i: int):
        *held[:], info = compiled.run(*held, target, jnp.int32(i))
        return held, info

    seconds = sample(call, repeats)
    if bool(call(0)[1]["skipped"]):
        raise RuntimeError("the fitting step was skipped: its plan was too small, or a number was not finite")
    return StepTimes(f"{FIT_GAUSSIANS} Gaussians, 1 camera of {width}x{height}", seconds, compiled.seconds)


def field(repeats: int) -> StepTimes:
    """One step of distilling a feature field, with the defaults: 256 channels, 16 levels, all losses."""
    width, height = FIT_SIZE
    scene = ball(FIT_GAUSSIANS, width, height)
    camera = Camera(scene.viewmat, scene.K, width, height)
    thing = np.indices((height, width)).sum(axis=0) // 40 % 3  # stripes
    teacher = teacher_of_objects([thing], [np.eye(3, 512, dtype=np.float32)])
    method = Distill(DistillConfig(iterations=repeats + 1, contrast_after=0.0))
    problem, run = method.start(gaussians_from_activated(*scene[:5]), [camera], teacher)
    what = f"{FIT_GAUSSIANS} Gaussians, 1 camera of {width}x{height}, {method.config.channels} channels"
    return _step_times(what, drive(method, problem, run))


def deform(repeats: int) -> StepTimes:
    """One step of a deforming scene, with the defaults: deformation, colours, features and graph."""
    seen = open_sequence(TISSUE)
    config = DeformConfig(warmup=0, iterations=repeats + 1, graph=GraphConfig(after=0.0))
    ticks = deform_steps(seen, config, tools="draw")
    what = f"{ticks.run.params.gaussians.num} Gaussians, 1 camera of {seen.width}x{seen.height}"
    return _step_times(what, ticks)


def _step_times(what: str, ticks: Iterable[Tick]) -> StepTimes:
    """Times of all steps of a loop; the first one compiles."""
    updates = list(ticks)
    if any(bool(update.info["skipped"]) for update in updates):
        raise RuntimeError("a step was skipped: a number was not finite")
    return StepTimes(what, [u.seconds for u in updates[1:]], updates[0].compile_seconds)


def _loss(gaussians, target, *, step, key, plan, camera):
    rendered = render(gaussians, camera, plan)
    return photometric_loss(rendered.colors, target), {"overflow": rendered.meta.overflow}


STEPS: dict[str, Callable[[int], StepTimes]] = {
    "steps-tracker": tracker,
    "steps-tracker-fast": partial(tracker, preset="fast"),
    "steps-fit": fit,
    "steps-field": field,
    "steps-deform": deform,
}


@dataclass(frozen=True)
class StepRow:
    """A row of the table of update rates."""

    name: str
    what: str
    updates: int
    median_ms: float
    p95_ms: float
    steps_per_s: float  # from the median
    compile_s: float
    noisy: bool

    def metrics(self) -> list[Metric]:
        return [
            Metric(f"{self.name}/rate", self.steps_per_s, "steps/s", "higher", 0.2, noisy=self.noisy),
            Metric(f"{self.name}/compile", self.compile_s, "s", "lower", 1.0, True, self.noisy),
        ]

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def measure_step(name: str, repeats: int, before: Floors) -> tuple[StepRow, Floors]:
    """Time one method's step, between the floors `before` and those returned, which are measured after it."""
    jax.clear_caches()
    times = STEPS[name](repeats)
    median, p95 = median_and_p95(times.seconds)
    after = measure_floors()
    noisy = not is_calm(before, after)
    row = StepRow(name, times.what, len(times.seconds), median, p95, 1e3 / median, times.compile_s, noisy)
    return row, after
