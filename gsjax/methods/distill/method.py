"""The method of the drive loop: views with their teacher, and the field that they train."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.distill.config import DistillConfig
from gsjax.methods.distill.field import active_table, init_field
from gsjax.methods.distill.result import DistillResult
from gsjax.methods.distill.teacher import Teacher, max_rows, view_codebook
from gsjax.methods.distill.update import Batch, contrast_begins, distill_step
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.frozen import FrozenView, freeze_views
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located
from gsjax.scene.gaussians import Gaussians


class Problem(NamedTuple):
    """The constants of a distillation.

    Attributes:
        views: a batch for each view with known pixels.
        rows: indices of the grid's entries that are trained; None without a grid.
        means: centres of the scene's Gaussians, metres.
        source, scene: as in `DistillResult`.
    """

    views: list[Batch]
    rows: Int[np.ndarray, "active"] | None
    means: Float[Array, "n 3"]
    source: Any
    scene: Mapping[str, Any]


@dataclass(frozen=True)
class Distill:
    """Distillation of a semantic field of a static scene (`gsjax.optim.method.Method`).

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
        _check(cameras, teacher)
        config = self.config
        found, located = init_field(jax.random.key(config.seed), config, gaussians.means, teacher.dimension)
        found, located, rows = active_table(found, located)
        most = max_rows(teacher)
        views = [
            view_batch(teacher, v, most, located, frozen)
            for v, frozen in enumerate(frozen_views(gaussians, cameras, rasterize_mode))
            if teacher.maps is not None or (teacher.ids[v] >= 0).any()
        ]
        about = {"num_gaussians": gaussians.num, "rasterize_mode": rasterize_mode} | dict(scene or {})
        problem = Problem(views, rows, jnp.asarray(gaussians.means), source, about)
        return problem, Run(found, jax.jit(self.step.init)(found))

    @property
    def step(self) -> Step:
        """See `distill_step`."""
        return distill_step(self.config)

    def total(self, problem: Problem) -> int:
        """Number of steps, `config.iterations`."""
        return self.config.iterations

    def period(self, problem: Problem) -> int:
        """Number of views."""
        return len(problem.views)

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """The run, without its guard as the contrastive loss begins. Arguments as for `Method.between`."""
        begins = self.config.weights.contrast and run.step == contrast_begins(self.config)
        return run.having(guard=None) if begins else run

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[Batch, tuple[str, ...]]:
        """The next view, in shuffled order, with its own plan. Arguments as for `Method.batch`."""
        return problem.views[shuffled_index(self.config.seed, run.step, len(problem.views))], ()

    def result(self, problem: Problem, run: Run) -> DistillResult:
        """The field. It shares the arrays of the run, which later steps may donate."""
        return DistillResult(run.params, problem.rows, problem.source, problem.scene, problem.means)


def view_batch(
    teacher: Teacher, v: int, rows: int, located: Located | None, frozen: tuple[FrozenView, Plan]
) -> Batch:
    """The input of a step on one view.

    Args:
        teacher: teacher of all views.
        v: index of the view.
        rows: number of rows to pad its codebook to, at least `max_rows`.
        located: locations of the Gaussians in the grid; None without one.
        frozen: the scene in the view's camera, and its plan.
    """
    (view, plan), (ids, codebook) = frozen, view_codebook(teacher, v, rows)
    pixels = None if teacher.maps is None else teacher.maps[v]
    return Batch(view, located, *jax.device_put((ids, codebook)), pixels, plan)


def frozen_views(
    gaussians: Gaussians, cameras: Sequence[Camera], rasterize_mode: str = "classic"
) -> list[tuple[FrozenView, Plan]]:
    """The frozen scene in each camera. Views of one size share their plan and the lengths of their lists.

    Args:
        gaussians: the scene.
        cameras: cameras of the views.
        rasterize_mode: "classic" or "antialiased", as the scene was fitted.
    """
    kinds = [(camera.width, camera.height, camera.near, camera.fisheye is not None) for camera in cameras]
    found: dict[int, tuple[FrozenView, Plan]] = {}
    for kind in sorted(set(kinds)):
        which, (width, height, near, bends) = [v for v, each in enumerate(kinds) if each == kind], kind
        scene = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
        viewmats, Ks, fisheye = (
            jax.device_put(np.stack([getattr(cameras[v], name) for v in which])) if name else None
            for name in ("viewmat", "K", "fisheye" if bends else None)
        )
        options = {"fisheye": fisheye, "near_plane": near, "rasterize_mode": rasterize_mode}
        views, plan = freeze_views(*scene, viewmats, Ks, width, height, **options)
        views = jax.device_get(views)
        for place, v in enumerate(which):
            found[v] = (jax.device_put(jax.tree.map(lambda a, place=place: a[place], views)), plan)
    return [found[v] for v in range(len(cameras))]


def _check(cameras: Sequence[Camera], teacher: Teacher) -> None:
    if len(cameras) != len(teacher.ids):
        raise ValueError(f"teacher: expected ids of {len(cameras)} views, found {len(teacher.ids)}")
    if teacher.maps is not None and len(teacher.maps) != len(cameras):
        raise ValueError(f"teacher: expected maps of {len(cameras)} views, found {len(teacher.maps)}")
    for v, (camera, ids) in enumerate(zip(cameras, teacher.ids, strict=True)):
        if ids.shape != (camera.height, camera.width):
            raise ValueError(
                f"teacher: expected {camera.width}x{camera.height} pixels in view {v} like its camera, found "
                f"{ids.shape[1]}x{ids.shape[0]}"
            )
