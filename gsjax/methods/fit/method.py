"""The host loop of a fit: which photograph is next, at what size, with which capacity."""

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.fit.config import FitConfig
from gsjax.methods.fit.model import Model, carried_over, model_of, refined, with_degree, with_slots
from gsjax.methods.fit.start import Extent, View, extent_of, in_slots, start_points
from gsjax.methods.fit.update import (
    Batch,
    Observation,
    fit_step,
    grow,
    slots_wanted,
    split,
)
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.compiler import host_options
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import plan_render

_HEADROOM = 1.3
_RANDOM_BACKGROUND, _WALK, _GROWTH = range(3)  # what keys are for


class Problem(NamedTuple):
    """What does not change during a fit.

    Attributes:
        views: the photographs to fit, on the host.
        config: how.
        extent: where the scene is.
        background: RGB behind the scene; None: another in each step.
        start: where the first Gaussians come from: cloud, depth or random.
    """

    views: list[View]
    config: FitConfig
    extent: Extent
    background: tuple[float, float, float] | None
    start: str


class FitState(eqx.Module):
    """What a fit goes on from, to the same bits.

    Attributes:
        model: what is fitted. Of the Gaussians' slots, those that are not alive are empty.
        optimizer: what the step carries along.
        step: how many steps were made.
        capacity: of the plan for each size of photographs, a row (shrink, width, height, capacity) each.
    """

    model: Model
    optimizer: Any
    step: int
    capacity: Int[np.ndarray, "sizes 4"]

    @property
    def gaussians(self) -> Gaussians:
        """Of all slots."""
        return self.model.gaussians


class Fitted(NamedTuple):
    """A fit after one more step.

    Attributes:
        state: to go on from. Its arrays are given away in the next step: copy what is to be kept.
        info: loss, psnr, alive, skipped of this step, on the device.
        seconds: that it took, without what compiled.
        compile_seconds: that compiling took in it.
        shrink: how many times smaller the photograph was.
    """

    state: FitState
    info: dict[str, Array]
    seconds: float
    compile_seconds: float
    shrink: int


def begin(
    views: list[View],
    config: FitConfig,
    cloud: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None,
    background: tuple[float, float, float] | None = None,
) -> tuple[Problem, FitState]:
    """A fit before its first step.

    Args:
        views: the photographs.
        config: how they are fitted.
        cloud: points of the scene and their colours, 0 to 1.
        background: what is behind the scene, where the data says so.

    Raises:
        ValueError: there is no view, or none in which a pixel counts, or nothing of the kind from which the
            fit is to start, or another background is asked for than the data has.
    """
    if not views:
        raise ValueError("views: expected at least one photograph to fit, found none")
    if background is not None and config.background != "data":
        raise ValueError(
            f"background: the photographs stand on {background} where nothing is, which before "
            f"{config.background!r} would be learned as a thing; leave it at data"
        )
    if not any(view.mask is None or view.mask.any() for view in views):
        raise ValueError("masks: in none of the photographs to fit does any pixel count; are they inverted?")
    extent = extent_of(np.stack([view.viewmat for view in views]))
    points, colors, source = start_points(views, cloud, config.start, config.seed)
    slots = config.cap if config.strategy == "relocate" else min(config.cap, rung(1.5 * len(points)))
    gaussians = in_slots(points, colors, slots, config.start, config.seed)
    behind = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "random": None}
    behind["data"] = background or behind["black"]
    problem = Problem(views, config, extent, behind[config.background], source)
    model = model_of(gaussians, config, len(views))
    state = fit_step(config, extent.radius).init(model)
    return problem, FitState(model, state, 0, np.zeros((0, 4), int))


def fit(
    problem: Problem,
    state: FitState,
    *,
    share: Callable[[int], float] | None = None,
    extra_losses: ExtraLosses = (),
) -> Iterator[Fitted]:
    """Step by step, until all is done. The same state, problem and `share` give the same bits, wherever the
    fit was begun or resumed.

    Args:
        problem: from `begin`.
        state: from `begin`, or that of an earlier `Fitted`.
        share: step -> what share of the fit is done before it, by which rates fall and photographs grow; at 1
            it ends. That of the config's steps unless given.
        extra_losses: functions `loss(scene, rendered, frame)` of one's own, whose scene is a `Model`; see
            `gsjax.losses.extra`. `info["extra"]` has their values.
    """
    config, views = problem.config, problem.views
    key = jax.random.key(config.seed)
    plans = {tuple(row[:3].tolist()): int(row[3]) for row in state.capacity}
    named_losses(extra_losses)  # before it is a key, which a list cannot be
    advance, densify = _compiled(config, problem.extent.radius, extra_losses)
    seen: dict[tuple[int, int], Observation] = {}
    model, optimizer = state.model, state.optimizer
    compiled: set[Any] = set()
    # All observations are of one kind, for each kind is a program of its own.
    kinds = any(_counts(view) is not None for view in views), any(view.depth is not None for view in views)
    i = state.step
    while (done := i / config.steps if share is None else share(i)) < 1:
        begun, compiling = perf_counter(), 0.0
        degree = min(config.sh_degree, i // config.sh_every)
        model, optimizer = enlarged(problem, model, optimizer, degree, 0)
        v, shrink = shuffled_index(config.seed, i, len(views)), _shrink(config, done)
        if (v, shrink) not in seen:
            if any(of != shrink for _, of in seen):
                seen.clear()  # photographs of a size that is over
            seen[v, shrink] = _observe(views[v], v, shrink, kinds)
        observed = seen[v, shrink]
        size = (shrink, observed.camera.width, observed.camera.height)
        while True:
            if size not in plans:
                plans[size] = _plan(problem, model.gaussians, observed.camera, 0).capacity
            plan = _plan(problem, model.gaussians, observed.camera, plans[size])
            batch = Batch(observed, _background(problem, key, i), plan)
            new = (plan, model.gaussians.num)
            walk = jax.random.fold_in(jax.random.fold_in(key, _WALK), i)
            model, optimizer, info = advance(model, optimizer, batch, done, walk)
            overflow = bool(info["overflow"])
            if new not in compiled:  # planning and the first call of a program are not the time of a step
                compiling = perf_counter() - begun
                compiled.add(new)
            if not overflow:
                break
            plans[size] = plan.grown(int(info["needed"]), _HEADROOM).capacity
        if _densifies(config, i, done):
            started, new = perf_counter(), (model.gaussians.num, model.gaussians.sh_degree)
            turn = jax.random.fold_in(jax.random.fold_in(key, _GROWTH), i)
            if config.strategy == "split":
                room = min(config.cap, rung(int(slots_wanted(model, optimizer, config))))
                model, optimizer = enlarged(problem, model, optimizer, 0, room)
            model, optimizer = densify(model, optimizer, turn, i, _all_looked(config, i, len(views)))
            if new not in compiled:
                compiling += perf_counter() - started
                compiled.add(new)
        i += 1
        capacity = np.array([[*of, room] for of, room in plans.items()], int)
        now = FitState(model, optimizer, i, capacity)
        yield Fitted(now, info, perf_counter() - begun - compiling, compiling, shrink)


@lru_cache(maxsize=2)
def _compiled(config: FitConfig, radius: float, extra_losses: ExtraLosses) -> tuple[Callable, Callable]:
    """The jitted step and what makes more Gaussians; buffers that they replace are given away."""
    step, options = fit_step(config, radius, extra_losses), host_options()

    @partial(jax.jit, compiler_options=options, donate_argnums=(0, 1))
    def advance(model, optimizer, batch, share, key):
        return step.update(model, optimizer, batch, step=share, key=key)

    @partial(jax.jit, compiler_options=options, donate_argnums=(0, 1))
    def densify(model, optimizer, key, i, all_looked):
        if config.strategy == "relocate":
            return grow(model, optimizer, key, config.cap, config.growth.factor, all_looked)
        every, between = config.split.reset_every, config.split.every
        reset = i // every > jnp.maximum(i - between, 0) // every
        return split(model, optimizer, key, config, radius, reset, i > every, all_looked)

    return advance, densify


def _shrink(config: FitConfig, share: float) -> int:
    """How many times smaller photographs are: first 4, then 2."""
    if share >= config.coarse_until:
        return 1
    return 4 if share < config.coarse_until / 3 else 2


def _densifies(config: FitConfig, step: int, share: float) -> bool:
    when = config.growth if config.strategy == "relocate" else config.split
    return step >= when.begin and step % when.every == 0 and share < when.end


def _all_looked(config: FitConfig, step: int, views: int) -> bool:
    """Whether each photograph had a turn since this was last so; two rounds of turns hold a whole one."""
    if config.strategy == "split":  # which forgets each time what was seen
        return config.split.every >= 2 * views
    period = -(-2 * views // config.growth.every) * config.growth.every
    return step >= period and step % period == 0


def _counts(view: View) -> np.ndarray | None:
    """Which pixels count, where not all do."""
    return None if view.mask is None or view.mask.all() else view.mask


def _observe(view: View, number: int, shrink: int, kinds: tuple[bool, bool]) -> Observation:
    """A view on the device, in a picture of another size. `kinds`: with a mask, with depth, known or not."""
    image, mask, depth = view.image, _counts(view), view.depth
    masked, with_depth = kinds
    if masked and mask is None:
        mask = np.ones(image.shape[:2], bool)
    if with_depth and depth is None:
        depth = np.zeros(image.shape[:2], np.float32)
    height, width = (max(1, side // shrink) for side in image.shape[:2])
    factors = np.array([width / image.shape[1], height / image.shape[0], 1.0])
    if shrink > 1:
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        smaller = partial(cv2.resize, dsize=(width, height), interpolation=cv2.INTER_NEAREST_EXACT)
        mask = None if mask is None else smaller(mask.astype(np.uint8)) > 0
        depth = None if depth is None else smaller(depth)
    dtype = jnp.result_type(float)
    viewmat, K = (jnp.asarray(a, dtype)[None] for a in (view.viewmat, factors[:, None] * view.K))
    known = None if depth is None else jnp.asarray(depth, dtype)[None]
    counts = None if mask is None else jnp.asarray(mask)[None]
    camera = Camera(viewmat, K, width, height, view.near)
    return Observation(jnp.asarray(image)[None], counts, known, camera, jnp.asarray(number, jnp.int32))


def _plan(problem: Problem, gaussians: Gaussians, cameras: Camera, capacity: int) -> Plan:
    """A plan of this capacity, or, where that is 0, of what these cameras need."""
    mode = "antialiased" if problem.config.antialiased else "classic"
    if capacity == 0:
        return plan_render(gaussians, cameras, headroom=_HEADROOM, rasterize_mode=mode)
    options = {"rasterize_mode": mode, "render_mode": "RGB+ED", "sh_degree": gaussians.sh_degree}
    options["near_plane"] = cameras.near
    return Plan(cameras.width, cameras.height, capacity, **options)


def _background(problem: Problem, key: Array, step: int) -> Float[Array, "1 3"]:
    if problem.background is not None:
        return jnp.array([problem.background])
    return jax.random.uniform(jax.random.fold_in(jax.random.fold_in(key, _RANDOM_BACKGROUND), step), (1, 3))


def as_found(problem: Problem, model: Model) -> list[View]:
    """The views from where the fit found their cameras."""
    if model.twists is None:
        return problem.views
    viewmats = (
        refined(
            jnp.asarray(view.viewmat, jnp.float32)[None], model.twists, jnp.int32(i), problem.extent.radius
        )[0]
        for i, view in enumerate(problem.views)
    )
    found = [np.asarray(viewmat, np.float64) for viewmat in viewmats]
    return [view._replace(viewmat=viewmat) for view, viewmat in zip(problem.views, found, strict=True)]


def enlarged(problem: Problem, model: Model, optimizer: Any, degree: int, slots: int) -> tuple[Model, Any]:
    """With the coefficients of a degree, and with so many slots; what the optimizer knew is kept."""
    larger = with_slots(with_degree(model, degree), slots)
    if larger is model:
        return model, optimizer
    fresh = fit_step(problem.config, problem.extent.radius).init(larger)
    return larger, carried_over(optimizer, fresh)
