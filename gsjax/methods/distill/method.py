"""The distillation as one value: which views teach, which is next, and what comes of it."""

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
from gsjax.methods.distill.teacher import Teacher, most_rows, of_view
from gsjax.methods.distill.update import Batch, distill_step
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.rasterize.frozen import FrozenView, freeze_views
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians


class Problem(NamedTuple):
    """What does not change during a distillation.

    Attributes:
        views: a batch for each view that teaches something.
        rows: entries of the grid's table that train; None without a grid.
        means: centres of the scene's Gaussians, metres.
        source: the encoder of the teacher's features; see `DistillResult`.
        scene: the scene, as far as it is known; see `DistillResult`.
    """

    views: list[Batch]
    rows: Int[np.ndarray, "active"] | None
    means: Float[Array, "n 3"]
    source: Any
    scene: Mapping[str, Any]


@dataclass(frozen=True)
class Distill:
    """A semantic field for a static scene (`gsjax.optim.method.Method`).

    Attributes:
        config: settings of the field and its training.
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
            gaussians: the scene, which does not change.
            cameras: one for each view, viewmat [4,4] and K [3,3], of any sizes.
            teacher: of the same views.
            rasterize_mode: "antialiased" for a scene that was fitted with it.
            source: the encoder of the teacher's features; see `DistillResult`.
            scene: what is known of the scene; see `DistillResult`.

        Raises:
            ValueError: the teacher has other views, or of other sizes, or no Gaussian has a finite centre.
        """
        _check(cameras, teacher)
        config = self.config
        found, located = init_field(jax.random.key(config.seed), config, gaussians.means, teacher.dimension)
        found, located, rows = active_table(found, located)
        most, views = most_rows(teacher), []
        for v, (view, plan) in enumerate(frozen_views(gaussians, cameras, rasterize_mode)):
            if teacher.maps is None and not (teacher.ids[v] >= 0).any():
                continue  # it teaches nothing
            ids, codebook = of_view(teacher, v, most)
            codebook = None if codebook is None else jnp.asarray(codebook)
            of_pixels = None if teacher.maps is None else teacher.maps[v]
            views.append(Batch(view, located, jnp.asarray(ids), codebook, of_pixels, plan))
        about = {"num_gaussians": gaussians.num, "rasterize_mode": rasterize_mode} | dict(scene or {})
        problem = Problem(views, rows, jnp.asarray(gaussians.means), source, about)
        return problem, Run(found, self.step.init(found))

    @property
    def step(self) -> Step:
        """See `distill_step`."""
        return distill_step(self.config)

    def total(self, problem: Problem) -> int:
        """The iterations of the configuration."""
        return self.config.iterations

    def between(self, problem: Problem, run: Run, progress: float) -> Run:
        """The run as it is: shapes never change, and views are frozen. Arguments as for `Method.between`."""
        return run

    def batch(self, problem: Problem, run: Run, progress: float) -> tuple[Batch, tuple[str, ...]]:
        """The view whose turn it is, which has its own plan. Arguments as for `Method.batch`."""
        return problem.views[shuffled_index(self.config.seed, run.step, len(problem.views))], ()

    def result(self, problem: Problem, run: Run) -> DistillResult:
        """The field. Its arrays are those of the run: copy what is to be kept."""
        return DistillResult(run.params, problem.rows, problem.source, problem.scene, problem.means)


def frozen_views(
    gaussians: Gaussians, cameras: Sequence[Camera], rasterize_mode: str = "classic"
) -> list[tuple[FrozenView, Plan]]:
    """The scene in each camera. Views of one size share their plan and the lengths of their lists.

    Args:
        gaussians: the scene.
        cameras: of the views.
        rasterize_mode: "classic" or "antialiased", as the scene was fitted.
    """
    sizes = sorted({(camera.width, camera.height, camera.near) for camera in cameras})
    found: dict[int, tuple[FrozenView, Plan]] = {}
    for width, height, near in sizes:
        which = [v for v, c in enumerate(cameras) if (c.width, c.height, c.near) == (width, height, near)]
        scene = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
        viewmats, Ks = (jnp.stack([getattr(cameras[v], n) for v in which]) for n in ("viewmat", "K"))
        views, plan = freeze_views(
            *scene, viewmats, Ks, width, height, near_plane=near, rasterize_mode=rasterize_mode
        )
        for place, v in enumerate(which):
            found[v] = (jax.tree.map(lambda a, place=place: a[place], views), plan)
    return [found[v] for v in range(len(cameras))]


def _check(cameras: Sequence[Camera], teacher: Teacher) -> None:
    if len(cameras) != len(teacher.ids):
        raise ValueError(f"teacher: expected that of {len(cameras)} views, found {len(teacher.ids)}")
    if teacher.maps is not None and len(teacher.maps) != len(cameras):
        raise ValueError(f"teacher: expected maps of {len(cameras)} views, found {len(teacher.maps)}")
    for v, (camera, ids) in enumerate(zip(cameras, teacher.ids, strict=True)):
        if ids.shape != (camera.height, camera.width):
            raise ValueError(
                f"teacher: expected {camera.width}x{camera.height} pixels of view {v} like its camera, found "
                f"{ids.shape[1]}x{ids.shape[0]}"
            )
