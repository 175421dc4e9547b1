"""The method that fits a scene: the order and size of photographs, render plans, and the schedule of
densification."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.geometry.cameras import on_device
from gsjax.geometry.extent import Extent, extent_of
from gsjax.geometry.neighbors import valid_depth
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.fit.config import FitConfig
from gsjax.methods.fit.model import Model, extend_state, model_of, refined, with_degree, with_slots
from gsjax.methods.fit.padding import with_common_sizes
from gsjax.methods.fit.start import initial_gaussians, start_points
from gsjax.methods.fit.update import Batch, fit_step, grow, slots_wanted, split
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.compiler import host_jit
from gsjax.optim.densification import is_alive
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.plan import HEADROOM, rung
from gsjax.scene.frame import Frame, with_black_gaps
from gsjax.scene.gaussians import Gaussians, cull_invalid, take
from gsjax.scene.initialize import warn_of_hidden
from gsjax.scene.render import plan_render

_BACKGROUND, _GROWTH = 0, 2  # folded into the seed for the keys of these purposes


class Problem(NamedTuple):
    """The constants of a fit, with a cache.

    Attributes:
        frames: the photographs to fit, with one camera each, on the host, padded to common sizes.
        shares: the share of each one's width and height that is not padding; None if none is padded.
        extent: the extent of the scene.
        background: RGB behind the scene; None: random in each step.
        start: source of the initial Gaussians: cloud, depth, matches or random.
        shrink: progress -> the factor by which photographs are downscaled.
        held: photographs at the current size, on the device; filled on demand.
    """

    frames: list[Frame]
    shares: Float[np.ndarray, "n 2"] | None
    extent: Extent
    background: tuple[float, float, float] | None
    start: str
    shrink: Callable[[float], int]
    held: dict[tuple[int, int], Frame]


@dataclass(frozen=True)
class Fit:
    """A static scene from posed photographs (`gsjax.optim.method.Method`).

    Attributes:
        config: settings.
        extra_losses: custom losses `loss(scene, rendered, frame)`, whose scene is a `Model`; see
            `gsjax.losses.extra`. `info["extra"]` has their values.
    """

    config: FitConfig = field(default_factory=FitConfig)
    extra_losses: ExtraLosses = ()

    def __post_init__(self):
        named_losses(self.extra_losses)

    def start(
        self,
        frames: list[Frame],
        cloud: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None,
        background: tuple[float, float, float] | None = None,
    ) -> tuple[Problem, Run]:
        """The problem and the run before the first step.

        Args:
            frames: the photographs, each a frame of one camera on the host.
            cloud: points of the scene and their colours, 0 to 1.
            background: RGB behind the scene, if known from the data.

        Raises:
            ValueError: there is no photograph, no pixel counts, the source of the initial Gaussians is not
                available, or the requested background differs from the data's.
        """
        config = self.config
        if not frames:
            raise ValueError("views: expected at least one photograph to fit, found none")
        if background is not None and config.background != "data":
            raise ValueError(
                f"background: expected data, as the photographs were composited on {background}, which would "
                f"otherwise be learned as an object; found {config.background!r}; leave it at data"
            )
        if not any(frame.masks is None or frame.masks.any() for frame in frames):
            raise ValueError("masks: no pixel counts in any of the photographs to fit; are they inverted?")
        frames = [with_black_gaps(frame) for frame in frames]
        extent = extent_of(np.concatenate([frame.cameras.viewmat for frame in frames]))
        points, colors, source = start_points(frames, cloud, config.start, config.seed)
        warn_of_hidden(points, frames)
        slots = config.cap if config.strategy == "relocate" else min(config.cap, rung(1.5 * len(points)))
        gaussians = initial_gaussians(points, colors, slots, config.start, config.seed)
        behind = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": None}
        behind["data"] = background or behind["black"]
        model = model_of(gaussians, config, len(frames))
        shown, shares = with_common_sizes(frames)
        problem = Problem(
            shown, shares, extent, behind[config.background], source, partial(shrink_at, config), {}
        )
        return problem, Run(model, jax.jit(self.step.init)(model))

    @property
    def step(self) -> Step:
        """See `fit_step`."""
        return fit_step(self.config, self.extra_losses)

    def total(self, problem: Problem) -> int:
        """Number of steps."""
        return self.config.steps

    def period(self, problem: Problem) -> int:
        """Number of photographs."""
        return len(problem.frames)

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """Relocates or splits Gaussians, unlocks the next degree of the spherical harmonics, and plans the
        rendering of new sizes, whose losses are not comparable. Arguments as for `Method.between`."""
        run = self._densified(problem, run, run.step - 1, progress)
        run = self._enlarged(run, degree=min(self.config.sh_degree, run.step // self.config.sh_every))
        name, frame = self._frame_of_step(problem, run.step, progress)
        plan, gaussians = run.plans.get(name), run.params.gaussians
        if plan is None:
            mode = "antialiased" if self.config.antialiased else "classic"
            plan = plan_render(gaussians, frame.cameras, headroom=HEADROOM, rasterize_mode=mode)
            run = run.having(guard=None)
        return run.having(plans=run.plans | {name: replace(plan, sh_degree=gaussians.sh_degree)})

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[Batch, tuple[str, ...]]:
        """The photograph of the step, and the plan for its size. Arguments as for `Method.batch`."""
        name, frame = self._frame_of_step(problem, run.step, progress)
        if problem.background is None:
            key = jax.random.fold_in(jax.random.key(self.config.seed), _BACKGROUND)
            background = jax.random.uniform(jax.random.fold_in(key, run.step), (1, 3))
        else:
            background = jnp.array([problem.background])
        view = self._view(problem, run.step)
        share = None if problem.shares is None else jnp.asarray(problem.shares[view], jnp.float32)
        view = jnp.asarray(view, jnp.int32)
        batch = Batch(frame, view, background, progress, problem.extent.radius, run.plans[name], share)
        return batch, (name,)

    def result(self, problem: Problem | None, run: Run) -> Gaussians:
        """The Gaussians without empty slots."""
        gaussians = run.params.gaussians
        return cull_invalid(take(gaussians, np.asarray(is_alive(gaussians))))[0]

    def _view(self, problem: Problem, step: int) -> int:
        return shuffled_index(self.config.seed, step, len(problem.frames))

    def _frame_of_step(self, problem: Problem, step: int, progress: float) -> tuple[str, Frame]:
        """The photograph of a step on the device, and the name of the plan for its size."""
        view, shrink = self._view(problem, step), problem.shrink(progress)
        if (view, shrink) not in problem.held:
            if any(held != shrink for _, held in problem.held):
                problem.held.clear()  # of an earlier size
            problem.held[view, shrink] = on_device_at(problem.frames, view, shrink)
        frame = problem.held[view, shrink]
        return f"{shrink}:{frame.cameras.width}x{frame.cameras.height}", frame

    def _enlarged(self, run: Run, *, degree: int = 0, slots: int = 0) -> Run:
        """The run with spherical harmonics up to a degree and a number of slots; keeps the optimizer's
        state."""
        larger = with_slots(with_degree(run.params, degree), slots)
        if larger is run.params:
            return run
        return run.having(params=larger, state=extend_state(run.state, jax.jit(self.step.init)(larger)))

    def _densified(self, problem: Problem, run: Run, step: int, progress: float) -> Run:
        """The run after densification, if it is due after `step`."""
        config = self.config
        when = config.growth if config.strategy == "relocate" else config.split
        if step < when.begin or step % when.every or progress >= when.end:
            return run
        room = config.cap  # a run resumed with a larger cap has fewer slots until now
        if config.strategy == "split":
            room = min(room, rung(int(slots_wanted(run.params, run.state, config))))
        run = self._enlarged(run, slots=room)
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), _GROWTH), step)
        seen = _all_seen_since(config, step, len(problem.frames))
        params, state = _densified(run.params, run.state, key, step, seen, problem.extent.radius, config)
        return run.having(params=params, state=state)


@partial(host_jit, static_argnames="config", donate_argnums=(0, 1))
def _densified(model, optimizer, key, step, all_seen, radius, config: FitConfig):
    """The model and its optimizer after relocation or splitting."""
    if config.strategy == "relocate":
        return grow(model, optimizer, key, config.cap, config.growth.factor, all_seen)
    every, between = config.split.reset_every, config.split.every
    reset = step // every > jnp.maximum(step - between, 0) // every
    return split(model, optimizer, key, config, radius, reset, step > every, all_seen)


def shrink_at(config: FitConfig, progress: float) -> int:
    """The factor by which photographs are downscaled: first 4, then 2, then 1."""
    if progress >= config.coarse_until:
        return 1
    return 4 if progress < config.coarse_until / 3 else 2


def _all_seen_since(config: FitConfig, step: int, views: int) -> bool:
    """Whether, after `step`, every photograph was used since this was last true: any 2 n consecutive steps
    contain a whole epoch over n views. Arguments: the config, and the number of views.
    """
    if config.strategy == "split":  # which resets visibility each time
        return config.split.every >= 2 * views
    period = -(-2 * views // config.growth.every) * config.growth.every
    return step >= period and step % period == 0


def on_device_at(frames: list[Frame], view: int, shrink: int) -> Frame:
    """A downscaled photograph on the device.

    All have the same structure, with a mask if any photograph masks out pixels, and with depth if any has
    depth, so that one program serves all.

    Args:
        frames: all photographs, on the host.
        view: index of the photograph.
        shrink: factor by which it is downscaled, 1 or more.
    """
    frame = frames[view]
    image = frame.images[0]
    mask = None if frame.masks is None or _counts_all(frame) else frame.masks[0]
    depth = None if frame.depths is None else np.where(valid_depth(frame.depths[0]), frame.depths[0], 0)
    if mask is None and not all(map(_counts_all, frames)):
        mask = np.ones(image.shape[:2], bool)
    if depth is None and any(other.depths is not None for other in frames):
        depth = np.zeros(image.shape[:2], np.float32)
    height, width = (max(1, side // shrink) for side in image.shape[:2])
    factors = np.array([width / image.shape[1], height / image.shape[0], 1.0])
    if shrink > 1:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        smaller = partial(cv2.resize, dsize=(width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        mask = None if mask is None else smaller(mask.astype(np.uint8)) > 0
        depth = None if depth is None else smaller(depth)
    cameras = frame.cameras
    camera = replace(cameras, K=factors[:, None] * cameras.K, width=width, height=height)
    return Frame(
        jax.device_put(image[None]),
        None if depth is None else jax.device_put(depth[None].astype(jnp.result_type(float))),
        on_device(camera),
        None if mask is None else jax.device_put(mask[None]),
    )


def _counts_all(frame: Frame) -> bool:
    return frame.masks is None or bool(frame.masks.all())


def refined_frames(problem: Problem, model: Model) -> list[Frame]:
    """The photographs with the refined poses of their cameras."""
    if model.twists is None:
        return problem.frames
    found = []
    for i, frame in enumerate(problem.frames):
        given = jnp.asarray(frame.cameras.viewmat, jnp.float32)
        viewmat = refined(given, model.twists, jnp.int32(i), problem.extent.radius)
        found.append(eqx.tree_at(lambda f: f.cameras.viewmat, frame, np.asarray(viewmat, np.float64)))
    return found
