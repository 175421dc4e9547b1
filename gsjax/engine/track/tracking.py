"""The tracker's loop: an update per frame, with ticks as in `gsjax.engine.drive`, within a budget if there is
one."""

import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.engine.drive import Clock, Tick, announce, warn_of_lost_losses
from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.losses.extra import ExtraLosses, Recompiling
from gsjax.methods.track.budget import Costs, Governor, choose, ladder, unused_settings
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape, shape_of
from gsjax.methods.track.method import PLAN, Track
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.state import TrackBatch
from gsjax.optim.compiler import host_options
from gsjax.optim.method import Run
from gsjax.optim.traces import jit_once
from gsjax.scene.frame import Frame

_TRIALS = 5  # updates, whose median is the cost of one


def track(
    scene: TrackedScene,
    first: Frame,
    frames: Iterable[Frame],
    config: TrackConfig | None = None,
    *,
    budget_ms: float | None = None,
    after: Tick | None = None,
    like: Callable[[], Tick | None] = lambda: None,
    extra_losses: ExtraLosses = (),
) -> Iterator[Tick]:
    """Track the objects of `scene` through `frames` (those after the first one), one tick per frame.

    Nothing is compiled between frames, unless a plan overflows: then the frame is repeated with the next
    rung, from the state before it, so nothing is lost.

    Args:
        scene: from `start_scene` or `scene_from_shapes`; not used with `after`.
        first: the frame that `scene` shows or, if given, `after`.
        frames: the frames after it, in order of time; all of one size and number of cameras.
        config: see `TrackConfig` (default: its defaults).
        budget_ms: time that an update may take, milliseconds. The richest settings that keep to it are then
            chosen by measured cost, and of `config` only `start`, `grow.slots`, `headroom` and `seed` are
            used; a warning names others that are not the default.
        after: a tick to continue from, with its scene, state and chosen settings.
        like: returns a tick of another scene of the same shapes, or None. Its plan is reused, so that nothing
            is compiled for settings that it has too; see `gsjax.engine.track.rehearsal`.
        extra_losses: custom losses `loss(scene, rendered, frame)` added to the loss of the refinement; see
            `track_step`.

    Yields:
        ticks. `result` is the `Tracked` scene: `.scene`, `.pose`, `.labels` and `.gaussians()`. `info` is
        that of `track_step`; `run.plans["track"]` is the plan, and `run.kept.chosen` the settings chosen for
        a budget. `seconds` go from images in memory to the new state, re-planning included. Before the first
        tick the update is planned and compiled and the first frame processed, which takes a minute or two
        unless `gsjax.keep_programs` has kept the programs; `compile_seconds` of that tick includes the
        compiling and the time that `like` took.

    Raises:
        ValueError: a frame has other shapes than the first one, the budget is not above 0, or there are extra
            losses and no refinement to add them to.
    """
    config = TrackConfig() if config is None else config
    if budget_ms is not None and not budget_ms > 0:
        raise ValueError(f"budget_ms: expected milliseconds above 0, found {budget_ms}")
    if budget_ms is not None and extra_losses:
        raise ValueError(
            "extra_losses: expected none under budget_ms, whose settings have no refinement to add them to; "
            "leave one of the two out"
        )
    frames = iter(frames)
    if after is not None:
        warn_of_lost_losses(after, extra_losses)
    at = perf_counter()
    known, clock = like(), Clock()
    waited = perf_counter() - at  # for another thread that compiles
    if budget_ms is None:
        method = Track(config, extra_losses)
        begun = _started(method, scene, first, after, known)
        yield from _ticks(method, *begun, first, frames, None, waited + clock.read()[1])
        return
    if unused := unused_settings(config):
        named = ", ".join(unused)
        message = f"under a budget settings are chosen by their cost: {named} of yours will not be used"
        warnings.warn(message, UserWarning, stacklevel=2)
    count = (scene if after is None else after.run.params.scene).num_objects
    chosen = None if after is None else after.run.kept.chosen
    start = partial(_started, scene=scene, first=first, after=after, like=known, anew=chosen is None)
    if chosen is None:
        ahead = list(itertools.islice(frames, 1))
        frames = itertools.chain(ahead, frames)
        second = [*ahead, first][0]
        _check_alike(second, first, 1)
        rungs = ladder(config, len(first.images))
        chosen = choose(rungs, partial(_measured_costs, start, second), budget_ms / 1e3, count)
    method = Track(chosen.config)
    shape, run = start(method)
    run = run.having(kept=run.kept._replace(chosen=chosen))
    governor = Governor(budget_ms / 1e3, chosen.costs, count)
    yield from _ticks(method, shape, run, first, frames, governor, waited + clock.read()[1])


def _ticks(
    method: Track,
    shape: FrameShape,
    run: Run,
    first: Frame,
    frames: Iterable[Frame],
    governor: Governor | None,
    compiled: float,
) -> Iterator[Tick]:
    """One update per frame; the governor, or else the config, limits how many groups are searched for.
    `compiled`, the seconds of compiling before the first update, counts as the first's."""
    advance, count = _Updates(method, shape, run), run.params.scene.num_objects
    most = method.config.align.everywhere
    usually = count if most is None else min(most, count)
    for index, frame in enumerate(frames, start=1):
        _check_alike(frame, first, index)
        jax.block_until_ready(frame)
        raise_if_interrupted()
        everywhere = usually if governor is None else governor.allowed()
        run, info, seconds, compile_seconds = shielded(advance, run, frame, everywhere)
        if governor is not None:
            governor.spent(seconds, int(info["looked_for"].sum()))
        yield announce(Tick(method, shape, run, info, seconds, compiled + compile_seconds))
        compiled = 0.0


def first_update(scene: TrackedScene, first: Frame, config: TrackConfig) -> Tick:
    """The tick of an update to the first frame, after which its programs are compiled."""
    method = Track(config)
    shape, run = method.start(scene, first)
    run, info, *seconds = _Updates(method, shape, run)(run, first, 0)
    return Tick(method, shape, run, info, *seconds)


def _started(
    method: Track,
    scene: TrackedScene,
    first: Frame,
    after: Tick | None,
    like: Tick | None,
    anew: bool = False,
) -> tuple[FrameShape, Run]:
    """A run before its next frame; `anew` keeps only the scene of `after`, because its state belongs to other
    settings."""
    if after is None:
        shape, run = method.start(scene, first, like.run if like and like.method == method else None)
        return shape, _initialised(method, shape, run, first)
    if anew:
        shape, run = method.start_at(after.run.params, first)
        return shape, _initialised(method, shape, run, first).having(step=after.run.step)
    run = after.run
    if after.method.config != method.config:
        shape, planned = method.start_at(run.params, first)
        if not _same_shapes(planned.state, run.state):
            return shape, _initialised(method, shape, planned, first).having(step=run.step)
        run = run.having(plans=planned.plans, kept=planned.kept)
    return shape_of(first), run


def _same_shapes(state: Any, other: Any) -> bool:
    """Whether two states have the same structure and array shapes."""
    same = jax.tree.structure(state) == jax.tree.structure(other)
    return same and all(map(lambda a, b: a.shape == b.shape, *map(jax.tree.leaves, (state, other))))


def _initialised(method: Track, shape: FrameShape, run: Run, first: Frame) -> Run:
    """A run that had seen no frame yet, after an update to the first one."""
    return _Updates(method, shape, run)(run, first, 0)[0].having(step=run.step)


class _Updates:
    """The compiled update of one configuration, compiled again where a plan has become too small."""

    def __init__(self, method: Track, shape: FrameShape, run: Run):
        self._advance = Recompiling(
            method.extra_losses, partial(_compiled, method, shape, run.kept.reduction)
        )
        self._key = jax.random.key(method.config.seed)
        self._headroom = method.config.headroom

    def __call__(self, run: Run, frame: Frame, everywhere: int) -> tuple[Run, dict[str, Any], float, float]:
        """The run after a frame, info, the seconds that it took, and those of compiling; `everywhere` is the
        number of groups that may be searched for."""
        clock, step = Clock(), np.int32(run.step)
        while True:
            batch = TrackBatch(frame, run.plans[PLAN], jnp.int32(everywhere))
            result = jax.block_until_ready(self._advance(run.params, run.state, batch, step, self._key))
            params, state, info = result
            if not bool(info["overflow"]):
                return run.having(params=params, state=state, step=run.step + 1), info, *clock.read()
            run = run.grown((PLAN,), info["needed"], self._headroom)


@lru_cache(maxsize=8)
def _compiled(method: Track, shape: FrameShape, reduction: int, outside: tuple) -> Callable:
    """The jitted update, cached so that another sequence of the same shapes starts at once. Nothing is
    donated, so ticks stay valid. What its custom losses take from `outside` is compiled in."""
    update = method.step(shape, reduction).update

    def advance(params, state, batch, step, key):
        return update(params, state, batch, step=step, key=jax.random.fold_in(key, step))

    return jit_once(advance, (method, shape, reduction), compiler_options=host_options())


def _measured_costs(
    start: Callable[[Track], tuple[FrameShape, Run]], second: Frame, config: TrackConfig
) -> Costs:
    """The cost of updates, measured on the second frame, which shows new background if cameras move."""
    method = Track(config)
    shape, run = start(method)
    advance, count = _Updates(method, shape, run), run.params.scene.num_objects
    held = [run]

    def median(everywhere: int) -> tuple[float, int]:
        """Seconds, and the number of groups searched for."""
        trials = [shielded(advance, held[0], second, everywhere) for _ in range(_TRIALS)]
        held[0] = run.having(plans=trials[-1][0].plans)
        return float(np.median([trial[2] for trial in trials])), int(trials[0][1]["looked_for"].sum())

    median(0)  # the first calls fault their memory in
    base, (all_of_them, looked_for) = median(0)[0], median(count)
    return Costs(base, max(all_of_them - base, 0.0) / max(looked_for, 1))


def _check_alike(frame: Frame, first: Frame, index: int) -> None:
    for name in ("images", "depths"):
        found, wanted = getattr(frame, name), getattr(first, name)
        found, wanted = (None if a is None else a.shape for a in (found, wanted))
        if found != wanted:
            raise ValueError(
                f"frames: expected {name} of shape {wanted} as in the first frame, found {found} in frame "
                f"{index} after it; give all frames one size and the same cameras"
            )
