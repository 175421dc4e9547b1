"""The one loop over steps. It alone owns compiler options, the donation of buffers, overflow, what is compile
time, skipped steps, keys, headroom, and when Ctrl-C may strike.

    ticks = drive(method, problem, run)
    for now in ticks:
        print(now.step, now.info["loss"], now.seconds)
    ticks.result
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp

from gsjax.engine.interrupts import raise_if_interrupted, shielded
from gsjax.optim.compiler import compile_seconds, host_options
from gsjax.optim.method import Method, Run
from gsjax.rasterize.plan import HEADROOM


class Clock:
    """Wall time since it was made, with compiling apart."""

    def __init__(self):
        self._begun, self._compiled = perf_counter(), compile_seconds()

    def read(self) -> tuple[float, float]:
        """Seconds without compiling, and seconds of tracing and compiling."""
        compiling = compile_seconds() - self._compiled
        return max(0.0, perf_counter() - self._begun - compiling), compiling


@dataclass(frozen=True, eq=False)
class Tick:
    """A method after one more step.

    Attributes:
        method: the method, with its configuration; the tracker, which takes frames and not steps, is none but
            has `config` and `result` as well.
        problem: what does not change; None after `gsjax.load`.
        run: what there is to go on from. The next step takes over its arrays: copy what is to be kept.
        info: losses and diagnostics of this step by name, on the device; see `gsjax.optim.step`.
        seconds: wall time of the step, compiling apart.
        compile_seconds: time that went into tracing and compiling.
        progress: how far the schedule was before this step, 0 to 1.
    """

    method: Method | Any
    problem: Any
    run: Run
    info: dict[str, Any]
    seconds: float
    compile_seconds: float
    progress: float = 0.0

    @property
    def step(self) -> int:
        """How many steps were made."""
        return self.run.step

    @cached_property
    def result(self) -> Any:
        """What the method is for: Gaussians, parts, a field that answers queries, a scene over time."""
        return self.method.result(self.problem, self.run)


class Drive(Iterator[Tick]):
    """Steps of a method, made as they are asked for; see `drive`.

    Attributes:
        run: the newest run, whatever became of the tick that had it: Ctrl-C strikes between steps only.
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
        self._progress = self._of_total if progress is None else progress
        self._headroom = headroom
        self._advance = _compiled(method)
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
        """What the method has come to, also before the first step."""
        return self.method.result(self.problem, self.run) if self.tick is None else self.tick.result

    def _of_total(self, step: int) -> float:
        total = self.method.total(self.problem)
        return step / total if total else 1.0

    def _one_step(self, progress: float) -> Tick:
        clock, method, problem = Clock(), self.method, self.problem
        self.run = method.between(problem, self.run, progress)
        while True:
            run, step = self.run, jnp.asarray(self.run.step)
            batch, names = method.batch(problem, run, progress)
            params, state, info = self._advance(run.params, run.state, batch, step, self._key)
            self.run = run.having(params=params, state=state)
            if not bool(info["overflow"]):
                break
            self.run = self.run.grown(names, info["needed"], self._headroom)
        self.run = self.run.having(step=run.step + 1)
        self.tick = Tick(method, problem, self.run, info, *clock.read(), progress)
        return self.tick


def drive(
    method: Method,
    problem: Any,
    run: Run,
    *,
    progress: Callable[[int], float] | None = None,
    headroom: float = HEADROOM,
) -> Drive:
    """Step by step, until all is done. The same run, problem and progress give the same bits, wherever the
    run was begun or resumed.

    Args:
        method: which steps.
        problem: from the method's `start`.
        run: from `start`, or that of an earlier tick. Its arrays are given away in the first step.
        progress: step -> how far the schedule is before that step, 0 to 1; at 1 it ends. By default the
            share of the method's steps.
        headroom: how many times as much as was needed a plan holds after an overflow.
    """
    return Drive(method, problem, run, progress, headroom)


@lru_cache(maxsize=4)
def _compiled(method: Method) -> Callable:
    """The jitted update of a method, kept so that a second problem like the first starts at once."""
    update = method.step.update

    @partial(jax.jit, compiler_options=host_options(), donate_argnums=(0, 1))
    def advance(params, state, batch, step, key):
        return update(params, state, batch, step=step, key=jax.random.fold_in(key, step))

    return advance
