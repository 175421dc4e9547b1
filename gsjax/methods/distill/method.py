"""The method of the drive loop: a vote or a least-squares solution, then gradient descent on the losses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.geometry.neighbors import nearest_neighbors
from gsjax.methods.distill.config import DistillConfig
from gsjax.methods.distill.field import (
    FeatureField,
    active_table,
    expect_finite,
    fitted_to_vectors,
    init_field,
)
from gsjax.methods.distill.levels import complete_teacher
from gsjax.methods.distill.result import DistillResult
from gsjax.methods.distill.solve import SolveBatch, num_passes, solve_step, zero_field
from gsjax.methods.distill.teacher import Teacher, max_rows
from gsjax.methods.distill.update import contrast_begins, distill_step
from gsjax.methods.distill.views import Batch, check_views, frozen_views, in_basis, view_batch
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.guard import inactive
from gsjax.optim.method import Run
from gsjax.optim.step import Step, copied
from gsjax.scene.feature_grid import FeatureGrid, Located
from gsjax.scene.gaussians import Gaussians

_FIT = 1  # folded into the seed for the key of the grid's fit to vectors


class Problem(NamedTuple):
    """The constants of a distillation.

    Attributes:
        views: a batch for each view with known pixels.
        rows: indices of the grid's entries that are trained; None without a grid.
        means: centres of the scene's Gaussians, metres.
        source, scene: as in `DistillResult`.
        solving: the views with their teacher in the channels of a solution; empty without one.
        neighbors: the nearest neighbours of each Gaussian, for a solution; None without one.
        untrained: the field to train, before it is fitted to the solution; None unless there are both.
        located: the locations of the Gaussians in its grid; None without one.
    """

    views: list[Batch]
    rows: Int[np.ndarray, "active"] | None
    means: Float[Array, "n 3"]
    source: Any
    scene: Mapping[str, Any]
    solving: tuple[Batch, ...] = ()
    neighbors: Int[Array, "n k"] | None = None
    untrained: FeatureField | None = None
    located: Located | None = None


def field_step(config: DistillConfig) -> Step:
    """`solve_step` for a `SolveBatch`, `distill_step` for a `Batch`; both advance a `FeatureField`.

    Args:
        config: configuration of the distillation.
    """

    def of(is_solving: bool) -> Step:
        return solve_step(config) if is_solving else distill_step(config)

    def init(params: FeatureField) -> Any:
        return of(config.start != "random" and not isinstance(params.encoding, FeatureGrid)).init(params)

    def update(params: FeatureField, state: Any, batch: SolveBatch | Batch, *, step: Any, key: Any):
        return of(isinstance(batch, SolveBatch)).update(params, state, batch, step=step, key=key)

    return Step(init, update)


@dataclass(frozen=True)
class Distill:
    """Distillation of a semantic field of a static scene (`gsjax.optim.method.Method`): first, unless it
    starts at random, the passes of a vote or a solution; then steps of gradient descent.

    Attributes:
        config: configuration of the field and its training.
    """

    config: DistillConfig = field(default_factory=DistillConfig)

    def start(
        self,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        teacher: Teacher,
        rasterize_mode: str = "classic",
        *,
        source: Any = None,
        scene: Mapping[str, Any] | None = None,
    ) -> tuple[Problem, Run]:
        """A distillation before its first step.

        Args:
            gaussians: the scene, which stays fixed.
            cameras: one for each view, viewmat [4,4] and K [3,3], of any sizes.
            teacher: target features of the same views.
            rasterize_mode: "classic" or "antialiased", as the scene was fitted.
            source, scene: as in `DistillResult`.

        Raises:
            ValueError: the teacher's views differ in number or size, or no Gaussian has a finite centre.
        """
        check_views(cameras, teacher)
        expect_finite(gaussians.means)
        config, solved, located, rows, untrained = self.config, None, None, None, None
        frozen = frozen_views(gaussians, cameras, rasterize_mode)
        if teacher.filled is not None:
            teacher = complete_teacher(teacher, frozen, gaussians.num)
        if config.start != "random":
            solved = zero_field(teacher, jnp.asarray(gaussians.means), config)
            config = replace(config, channels=solved.channels)
        if config.iterations:
            untrained, located = init_field(
                jax.random.key(config.seed), config, gaussians.means, teacher.dimension
            )
            untrained, located, rows = active_table(untrained, located)
        most = max_rows(teacher)
        views = [
            view_batch(teacher, v, most, located, one)
            for v, one in enumerate(frozen)
            if teacher.maps is not None or (teacher.ids[v] >= 0).any()
        ]
        about = {"num_gaussians": gaussians.num, "rasterize_mode": rasterize_mode} | dict(scene or {})
        problem = Problem(views, rows, jnp.asarray(gaussians.means), source, about)
        if solved is None:
            return problem, Run(untrained, jax.jit(self.step.init)(untrained))
        near = nearest_neighbors(np.asarray(gaussians.means), config.solve.neighbors)
        neighbors = jnp.asarray(near, jnp.int32)
        solving = tuple(in_basis(view, solved.lift) for view in views)
        problem = problem._replace(solving=solving, neighbors=neighbors, untrained=untrained, located=located)
        return problem, Run(solved, jax.jit(self.step.init)(solved))

    @property
    def step(self) -> Step:
        """See `field_step`."""
        return field_step(self.config)

    def steps_of_solution(self, problem: Problem) -> int:
        """Number of steps before gradient descent: one for each view in each pass."""
        return num_passes(self.config) * len(problem.views)

    def total(self, problem: Problem) -> int:
        """Number of steps, those of the solution and `config.iterations`."""
        return self.steps_of_solution(problem) + self.config.iterations

    def period(self, problem: Problem) -> int:
        """Number of views."""
        return len(problem.views)

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """The run; after the last step of the solution, with the field to train. The guard is dropped where
        the loss is redefined. Arguments as for `Method.between`."""
        step = run.step - self.steps_of_solution(problem)
        if step < 0:
            return run.having(guard=inactive(run.guard))
        if step == 0 and problem.untrained is not None:
            key = jax.random.fold_in(jax.random.key(self.config.seed), _FIT)
            solved: FeatureField = run.params
            fitted = fitted_to_vectors(problem.untrained, problem.located, solved.encoding, key)
            params = copied(eqx.tree_at(lambda f: f.lift, fitted, solved.lift))
            state = jax.jit(distill_step(self.config).init)(params)
            return run.having(params=params, state=state, guard=None)
        begins = self.config.weights.contrast and step == contrast_begins(self.config)
        return run.having(guard=None) if begins else run

    def batch(
        self, problem: Problem, run: Run, progress: float
    ) -> tuple[SolveBatch | Batch, tuple[str, ...]]:
        """The next view: in order during a solution, shuffled during gradient descent.
        Arguments as for `Method.batch`."""
        begun, count = self.steps_of_solution(problem), len(problem.views)
        if run.step < begun:
            assert problem.neighbors is not None
            turn, v = divmod(run.step, count)
            return SolveBatch(problem.solving[v], problem.neighbors, turn, v == count - 1), ()
        v = shuffled_index(self.config.seed, run.step - begun, count)
        return problem.views[v]._replace(begun=begun), ()

    def result(self, problem: Problem, run: Run) -> DistillResult:
        """The field. It shares the arrays of the run, which later steps may donate."""
        rows = problem.rows if isinstance(run.params.encoding, FeatureGrid) else None
        return DistillResult(run.params, rows, problem.source, problem.scene, problem.means)
