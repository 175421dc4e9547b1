"""The tracker's loop: an update for each frame, in ticks as those of `gsjax.engine.drive`, and what a budget
leaves time for."""

import itertools
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.engine.drive import Clock, Tick
from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.losses.extra import ExtraLosses
from gsjax.methods.track.budget import Costs, Governor, choose, ladder
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape, shape_of
from gsjax.methods.track.method import PLAN, Track
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.state import TrackBatch
from gsjax.optim.compiler import host_options
from gsjax.optim.method import Run
from gsjax.scene.frame import Frame

_TRIALS = 5  # updates whose median says what one costs


def track(
    scene: TrackedScene,
    first: Frame,
    frames: Iterable[Frame],
    config: TrackConfig | None = None,
    *,
    budget_ms: float | None = None,
    after: Tick | None = None,
    extra_losses: ExtraLosses = (),
) -> Iterator[Tick]:
    """Follow the objects of `scene` through `frames` (those after the first one), one tick a frame.

    Nothing is compiled between frames, unless a plan overflows: then the frame is done again under the next
    rung, from the state before it, so nothing is lost.

    Args:
        scene: from `start_scene` or `scene_from_shapes`; not used with `after`.
        first: the frame that `scene` shows; with `after`, the frame that it shows.
        frames: the frames after it, in order of time; all of one size and number of cameras.
        config: see `TrackConfig`; the default settings unless given.
        budget_ms: what an update may take, milliseconds. The richest settings that keep to it are then chosen
            by measured cost, and of `config` only how a scene starts is used (see `budget`).
        after: a tick to go on from, with its scene, state and chosen settings.
        extra_losses: custom losses `loss(scene, rendered, frame)` beside the refinement's loss; see
            `track_step`.

    Yields:
        ticks. `result` is the `Tracked` scene: `.scene`, `.pose`, `.labels` and `.gaussians()`. `info` is
        that of `track_step`; `run.plans["track"]` the plan, and `run.kept.chosen` what was chosen for a
        budget. `seconds` go from images in memory to the new state, re-planning included.

    Raises:
        ValueError: a frame has other shapes than the first one, the budget is not above 0, or there are extra
            losses and no refinement to add them to.
    """
    config = TrackConfig() if config is None else config
    if budget_ms is not None and not budget_ms > 0:
        raise ValueError(f"budget_ms: expected milliseconds above 0, found {budget_ms}")
    method = Track(config, extra_losses)
    if budget_ms is not None and extra_losses:
        raise ValueError(
            "extra_losses: expected none under budget_ms, whose settings have no refinement to add them to; "
            "leave one of the two out"
        )
    frames, governor = iter(frames), None
    if budget_ms is None:
        shape, run = _begun(method, scene, first, after)
    else:
        chosen = None if after is None else after.run.kept.chosen
        if chosen is None:
            ahead = list(itertools.islice(frames, 1))
            frames = itertools.chain(ahead, frames)
            second = [*ahead, first][0]
            _check_alike(second, first, 1)
            start = partial(_begun, scene=scene, first=first, after=after, anew=True)
            measure = partial(_measured, start, second)
            rungs = ladder(config, len(first.images))
            chosen = choose(rungs, measure, budget_ms / 1e3, _groups(scene, after))
            method = Track(chosen.config)
            shape, run = start(method)
        else:
            method = Track(chosen.config)
            shape, run = _begun(method, scene, first, after)
        run = run.having(kept=run.kept._replace(chosen=chosen))
        governor = Governor(budget_ms / 1e3, chosen.costs, _groups(scene, after))
    yield from _ticks(method, shape, run, first, frames, governor)


def _ticks(
    method: Track,
    shape: FrameShape,
    run: Run,
    first: Frame,
    frames: Iterable[Frame],
    governor: Governor | None,
) -> Iterator[Tick]:
    """An update a frame.

    Args:
        method: the tracker.
        shape: of the frames.
        run: to go on from.
        first: what all frames are to be like.
        frames: in order of time.
        governor: how many groups there is time to look for everywhere; None: as the config says.
    """
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
        yield Tick(method, shape, run, info, seconds, compile_seconds)


def _begun(
    method: Track, scene: TrackedScene, first: Frame, after: Tick | None, anew: bool = False
) -> tuple[FrameShape, Run]:
    """A run before its next frame.

    Args:
        method: the tracker.
        scene: where it starts without `after`.
        first: the frame that the scene, or `after`, shows.
        after: a tick to go on from, or None.
        anew: of `after`, only where objects are counts: its state is of other settings.
    """
    if after is None:
        return method.start(scene, first)
    if anew:
        shape, run = method.start_at(after.run.params, first)
        return shape, run.having(step=after.run.step)
    run = after.run
    if after.method.config != method.config:  # which may draw otherwise
        _, planned = method.start_at(run.params, first)
        run = run.having(plans=planned.plans, kept=planned.kept)
    return shape_of(first), run


def _groups(scene: TrackedScene, after: Tick | None) -> int:
    return (scene if after is None else after.run.params.scene).num_objects


class _Updates:
    """The compiled update of one configuration, compiled again where a plan has become too small."""

    def __init__(self, method: Track, shape: FrameShape, run: Run):
        self._advance = _compiled(method, shape, run.kept.reduction)
        self._key = jax.random.key(method.config.seed)
        self._headroom = method.config.headroom

    def __call__(self, run: Run, frame: Frame, everywhere: int) -> tuple[Run, dict[str, Any], float, float]:
        """The run after a frame, info, the seconds that it took, and those of compiling.

        Args:
            run: before the frame.
            frame: as all cameras saw it.
            everywhere: how many groups may be looked for everywhere.
        """
        clock, step = Clock(), np.int32(run.step)
        while True:
            batch = TrackBatch(frame, run.plans[PLAN], jnp.int32(everywhere))
            result = jax.block_until_ready(self._advance(run.params, run.state, batch, step, self._key))
            params, state, info = result
            if not bool(info["overflow"]):
                return run.having(params=params, state=state, step=run.step + 1), info, *clock.read()
            run = run.grown((PLAN,), info["needed"], self._headroom)


@lru_cache(maxsize=8)
def _compiled(method: Track, shape: FrameShape, reduction: int) -> Callable:
    """The jitted update, kept so that a second sequence like the first starts at once. Nothing is donated:
    ticks stay what they are."""
    update = method.step(shape, reduction).update

    @partial(jax.jit, compiler_options=host_options())
    def advance(params, state, batch, step, key):
        return update(params, state, batch, step=step, key=jax.random.fold_in(key, step))

    return advance


def _measured(start: Callable[[Track], tuple[FrameShape, Run]], second: Frame, config: TrackConfig) -> Costs:
    """What updates cost: those to the second frame, which shows the background anew where cameras move.

    Args:
        start: gives the run before that frame.
        second: the frame.
        config: the settings to measure.
    """
    method = Track(config)
    shape, run = start(method)
    advance, count = _Updates(method, shape, run), run.params.scene.num_objects
    held = [run]

    def median(everywhere: int) -> tuple[float, int]:
        """Seconds, and how many groups there were to look for."""
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
                f"frames: number {index} after the first has {name} of shape {found}, expected {wanted} as "
                "in the first; give all frames one size and the same cameras"
            )
