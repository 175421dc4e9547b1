"""The method protocol: everything that a loop over steps has to know, as one value.

A method is a frozen dataclass that holds its configuration. `gsjax.engine.drive` runs any of them:

    problem, run = method.start(...)              # on the host
    run = method.between(problem, run, progress)  # before each step: what changes shapes now and then
    batch, plans = method.batch(problem, run, progress)
    params, state, info = method.step.update(run.params, run.state, batch, step=run.step, key=key)
    method.result(problem, run)
"""

from dataclasses import replace
from typing import Any, Protocol, TypeVar, runtime_checkable

import equinox as eqx
from jaxtyping import PyTree

from gsjax.optim.step import Step


class Run(eqx.Module):
    """What a method goes on from, to the same bits; one form for all methods.

    Attributes:
        params: what trains.
        state: what the step carries along: optimizers' moments, say.
        step: how many steps were made, which is the index of the next one.
        plans: capacities, by the name of what is drawn with them; see `gsjax.rasterize.plan`.
        kept: what steps are given as it is and `between` replaces: a graph, nodes, poses of the past. None
            for a method that needs nothing.
    """

    params: PyTree
    state: PyTree
    step: int = 0
    plans: dict[str, Any] = eqx.field(default_factory=dict)
    kept: PyTree = None

    def having(self, **changes: Any) -> "Run":
        """The same with other values of some fields."""
        return replace(self, **changes)

    def grown(self, names: tuple[str, ...], needed: Any, headroom: float) -> "Run":
        """The same with room for what a step needed.

        Args:
            names: of the plans that the step drew with.
            needed: what it needed of the plan, or of each of several.
            headroom: how many times as much a plan is to hold, 1 or more.
        """
        plans = dict(self.plans)
        for name, value in zip(names, needed if len(names) > 1 else (needed,), strict=True):
            plans[name] = plans[name].grown(value, headroom)
        return self.having(plans=plans)


Problem = TypeVar("Problem", contravariant=True)


@runtime_checkable
class Method(Protocol[Problem]):
    """A method; see the module. Everything but `step` runs on the host."""

    config: Any
    """A frozen dataclass with a `seed`, among others."""

    @property
    def step(self) -> Step:
        """The maths, for anyone's jit."""
        ...

    def total(self, problem: Problem) -> int:
        """How many steps there are; progress is the share of them that was made."""
        ...

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """The run before its next step: growth, new parts, a graph, plans of what is drawn for the first
        time. Arrays of the run may be given away.

        Args:
            problem: what does not change.
            run: after the step before.
            progress: how far the schedule is, 0 to 1.
        """
        ...

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[PyTree, tuple[str, ...]]:
        """What the next step is given, and the names in `run.plans` of the plans that it draws with, in the
        order of `info["needed"]`. Arguments as for `between`."""
        ...

    def result(self, problem: Problem, run: Run) -> Any:
        """What the user came for."""
        ...
