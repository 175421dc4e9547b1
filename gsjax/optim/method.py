"""The method protocol: one value that holds everything that a loop over steps needs.

A method is a frozen dataclass that holds its configuration. `gsjax.engine.drive` runs any of them:

    problem, run = method.start(...)              # on the host
    run = method.between(problem, run, progress)  # before each step: changes of shape
    batch, plans = method.batch(problem, run, progress)
    params, state, info = method.step.update(run.params, run.state, batch, step=run.step, key=key)
    method.result(problem, run)
"""

from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

from jaxtyping import PyTree

from gsjax.optim.guard import Guard
from gsjax.optim.step import Step


class Run(NamedTuple):
    """Everything needed to continue a method with bitwise equal results; all methods share this form.

    Attributes:
        params: trainable parameters.
        state: the step's own state, such as the moments of an optimizer.
        step: number of steps taken, which is the index of the next one.
        plans: capacities by name; see `gsjax.rasterize.plan`.
        kept: inputs of the steps that only `between` replaces, such as a graph, nodes or past poses; None for
            a method that has none.
        guard: what the driver's guard has seen; None before the first step.
    """

    params: PyTree
    state: PyTree
    step: int = 0
    plans: dict[str, Any] = {}  # noqa: RUF012 - a NamedTuple has no factories; nothing changes it in place
    kept: PyTree = None
    guard: Guard | None = None

    def having(self, **changes: Any) -> "Run":
        """A copy with some fields replaced."""
        return self._replace(**changes)

    def grown(self, names: tuple[str, ...], needed: Any, headroom: float) -> "Run":
        """A copy whose plans have room for what a step needed.

        Args:
            names: names of the plans that the step used.
            needed: what the step needed: a value for the plan, or one for each of several.
            headroom: capacity as a multiple of what was needed, 1 or more.
        """
        plans = dict(self.plans)
        for name, value in zip(names, needed if len(names) > 1 else (needed,), strict=True):
            plans[name] = plans[name].grown(value, headroom)
        return self.having(plans=plans)


Problem = TypeVar("Problem", contravariant=True)


@runtime_checkable
class Method(Protocol[Problem]):
    """A method; see the module's docstring. Everything but `step` runs on the host."""

    config: Any
    """The configuration: a frozen dataclass with a `seed` among its fields."""

    @property
    def step(self) -> Step:
        """The pure step, which may be called under any jit."""
        ...

    def total(self, problem: Problem) -> int:
        """Number of steps; progress is the fraction of them that has been taken."""
        ...

    def period(self, problem: Problem) -> int:
        """Number of steps in a pass over the views; a new pass begins after every multiple of it. 1 if steps
        do not form passes."""
        ...

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """The run for the next step, after changes of shape: densification, new parts, a graph, new plans.
        Arrays of `run` may be donated. The run is returned without its guard if the loss changes its meaning.

        Args:
            problem: the data, which does not change.
            run: the run after the previous step.
            progress: position in the schedule, 0 to 1.
        """
        ...

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[PyTree, tuple[str, ...]]:
        """The batch of the next step, and the names in `run.plans` of the plans that it uses, in the order of
        `info["needed"]`. Arguments as for `between`."""
        ...

    def result(self, problem: Problem, run: Run) -> Any:
        """The result of the method so far: Gaussians, parts, a field, a deforming scene."""
        ...
