"""The optimisation loop of all methods but the tracker. It takes care of compiler options, buffer donation,
capacity overflow, compile time, random keys, headroom, the guard against divergence, and when Ctrl-C may
interrupt. The tracker gets a new frame at every step, donates nothing and can keep to a time budget, so it
has a loop of its own, built from the same components (`gsjax.engine.track.tracking`).

    ticks = drive(method, problem, run)
    for now in ticks:
        print(now.step, now.info["loss"], now.seconds)
    ticks.result
"""

import operator
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.losses.extra import ExtraLosses, Recompiling, named_losses
from gsjax.optim.compiler import compile_seconds, host_options
from gsjax.optim.guard import Guard, new_guard, partial_step, window_of
from gsjax.optim.method import Method, Run
from gsjax.optim.traces import jit_once
from gsjax.rasterize.plan import HEADROOM


class Clock:
    """Wall-clock time since its creation, with compile time measured separately."""

    def __init__(self):
        self._begun, self._compiled = perf_counter(), compile_seconds()

    def read(self) -> tuple[float, float]:
        """Seconds excluding compilation, and seconds of tracing and compiling."""
        compiling = compile_seconds() - self._compiled
        return max(0.0, perf_counter() - self._begun - compiling), compiling


@dataclass(frozen=True, eq=False)
class Tick:
    """The state of a method after one more step.

    Attributes:
        method: the method, with its configuration; for the tracker, an object with `config` and `result`.
        problem: the fixed inputs of all steps; None after `gsjax.load`.
        run: the state to continue from. The next step donates its arrays: copy any that you keep.
        info: losses and diagnostics of this step by name, on the device; see `gsjax.optim.step`.
        seconds: wall-clock time of the step, without compiling.
        compile_seconds: time of tracing and compiling.
        progress: progress of the schedule before this step, 0 to 1.
    """

    method: Method | Any
    problem: Any
    run: Run
    info: dict[str, Any]
    seconds: float
    compile_seconds: float
    progress: float = 0.0

    def __repr__(self) -> str:
        known = {name: np.asarray(self.info[name]) for name in ("loss", "psnr") if name in self.info}
        known |= {name: np.asarray(value) for name, value in (self.info.get("extra") or {}).items()}
        numbers = {
            name: value for name, value in known.items() if value.shape == () and value.dtype.kind == "f"
        }
        told = [f"{name} {value:.4g}" for name, value in numbers.items()]
        return f"Tick(step {self.step}: {', '.join([*told, f'{self.seconds:.3g} s'])})"

    @property
    def step(self) -> int:
        """Number of steps so far."""
        return self.run.step

    @cached_property
    def result(self) -> Any:
        """The method's result: Gaussians, parts, a field that answers queries, or a scene over time."""
        return self.method.result(self.problem, self.run)


_SKIPPED = 10  # consecutive skipped steps after which custom losses are suspected

UPDATE = "/gsjax/update"
"""`jax.monitoring` event recorded after each tick, with its duration in seconds."""


COMPILING = "/gsjax/compiling"
"""`jax.monitoring` event recorded when a step begins to compile: the first, and any with new array shapes."""


def announce(tick: Tick) -> Tick:
    """Record the event of a tick, and return the tick."""
    jax.monitoring.record_event_duration_secs(UPDATE, tick.seconds)
    return tick


class Drive(Iterator[Tick]):
    """Iterates over the steps of a method; see `drive`.

    Attributes:
        run: the newest run. Ctrl-C interrupts between steps only (in a loop of one's own, before the next
            one), so it is always valid.
        tick: the newest tick; None before the first step.
    """

    def __init__(
        self,
        method: Method,
        problem: Any,
        run: Run,
        progress: Callable[[int], float] | None = None,
        headroom: float = HEADROOM,
    ):
        self.method, self.problem, self.run, self.tick = method, problem, run, None
        total = method.total(problem)
        self._window = window_of(total, method.period(problem))
        self._progress = (lambda step: step / total if total else 1.0) if progress is None else progress
        self._headroom = headroom
        self._losses: ExtraLosses = getattr(method, "extra_losses", ())
        self._advance = Recompiling(self._losses, partial(_compiled, method))
        self._skipped = 0  # consecutive steps
        self._key = jax.random.key(method.config.seed)

    def __iter__(self) -> "Drive":
        return self

    def __next__(self) -> Tick:
        raise_if_interrupted()
        if (progress := self._progress(self.run.step)) >= 1:
            raise StopIteration
        return shielded(self._one_step, progress)

    @property
    def result(self) -> Any:
        """The current result, available before the first step too."""
        return self.method.result(self.problem, self.run) if self.tick is None else self.tick.result

    def settle(self) -> None:
        """Return to the best parameters if the latest are worse. The last step of all does so itself; call
        this if a run ends earlier."""
        guard = self.run.guard
        if guard is None:
            return
        settled, params = guard.at_end(self.run.params)
        if settled is not guard:
            self.run = self.run.having(params=params, guard=settled)
            self.tick = None if self.tick is None else replace(self.tick, run=self.run)

    def _one_step(self, progress: float) -> Tick:
        clock, method, problem = Clock(), self.method, self.problem
        run = method.between(problem, self.run, progress)
        guard = _guard_of(self.run, run)
        self.run = run.having(guard=guard)
        while True:
            run, step = self.run, jnp.asarray(self.run.step)
            batch, names = method.batch(problem, run, progress)
            inputs = run.params, run.state, guard.share
            params, state, info = self._advance(*inputs, batch, step, self._key)
            self.run = run.having(params=params, state=state)
            overflow, skipped, loss = jax.device_get([info[name] for name in ("overflow", "skipped", "loss")])
            if not overflow:
                break
            self.run = self.run.grown(names, info["needed"], self._headroom)
        loss = np.nan if skipped else float(loss)
        self._skipped = self._skipped + 1 if skipped else 0
        if self._losses and self._skipped == _SKIPPED:
            _warn_of_skipped(info)
        guard, params = guard.after_step(loss, params, self._window)
        self.run = self.run.having(params=params, guard=guard, step=run.step + 1)
        if self._progress(self.run.step) >= 1:
            self.settle()
        self.tick = announce(Tick(method, problem, self.run, info, *clock.read(), progress))
        return self.tick


def drive(
    method: Method,
    problem: Any,
    run: Run,
    *,
    progress: Callable[[int], float] | None = None,
    headroom: float = HEADROOM,
) -> Drive:
    """Run a method step by step. The same run, problem and progress give bitwise identical results, even if
    the run is resumed.

    Args:
        method: the method.
        problem: from the method's `start`.
        run: from `start`, or from an earlier tick. Its arrays are donated to the first step.
        progress: step -> progress of the schedule before that step, 0 to 1; the loop ends at 1 (default:
            the fraction of the method's steps).
        headroom: capacity of a plan after an overflow, relative to what was needed.
    """
    return Drive(method, problem, run, progress, headroom)


def _guard_of(before: Run, run: Run) -> Guard:
    """The guard for the next step. It starts afresh when losses are no longer comparable: when parameters or
    constants were replaced, or `between` dropped it. An inactive guard stays so."""
    if run.guard is not None and run.guard.is_resting:
        return run.guard
    old, new = (jax.tree.leaves((one.params, one.kept)) for one in (before, run))
    is_same = len(old) == len(new) and all(map(operator.is_, old, new))
    return run.guard if run.guard is not None and is_same else new_guard(run.params, before.guard)


def warn_of_lost_losses(after: Tick, extra_losses: ExtraLosses) -> None:
    """Warn if a continued run was trained with custom losses that are not given now."""
    lost = sorted({*(after.info.get("extra") or ())} - {*named_losses(extra_losses)})
    if lost:
        warnings.warn(
            f"after: the run was trained with custom losses that are not given now: {', '.join(lost)}; "
            "gsjax.save does not store functions, so pass extra_losses again",
            UserWarning,
            stacklevel=4,
        )


def _warn_of_skipped(info: dict[str, Any]) -> None:
    values = {name: float(value) for name, value in info["extra"].items()}
    faulty = [f"{name} is {value}" for name, value in values.items() if not np.isfinite(value)]
    if not faulty:
        faulty = ["a gradient" if np.isfinite(float(info["loss"])) else "the method's own loss"]
    warnings.warn(
        f"{_SKIPPED} steps in a row changed nothing, as something is not finite: {', '.join(faulty)}",
        RuntimeWarning,
        stacklevel=5,
    )


@lru_cache(maxsize=4)
def _compiled(method: Method, outside: tuple) -> Callable:
    """The jitted update of a method, cached so that a similar second problem starts at once. What the custom
    losses capture from `outside` is compiled in as constants."""
    update = method.step.update

    def advance(params, state, share, batch, step, key):
        jax.monitoring.record_event(COMPILING)  # Python runs only while JAX traces
        new, state, info = update(params, state, batch, step=step, key=jax.random.fold_in(key, step))
        return partial_step(new, params, share), state, info

    return jit_once(advance, method, compiler_options=host_options(), donate_argnums=(0, 1))
