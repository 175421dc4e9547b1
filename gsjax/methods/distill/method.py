"""The host loop of a distillation: which view is next, what goes to the device, what comes back."""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from time import perf_counter
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.distill.config import DistillConfig
from gsjax.methods.distill.field import FeatureField, init_field, used_part, whole
from gsjax.methods.distill.teacher import Teacher, most_rows, of_view
from gsjax.methods.distill.update import DistillBatch, distill_step
from gsjax.methods.sampling import shuffled_index
from gsjax.optim.compiler import host_options
from gsjax.rasterize.frozen import FrozenView, freeze_views
from gsjax.rasterize.plan import Plan
from gsjax.scene.gaussians import Gaussians

_PATCHES = 1  # what keys are for, beside first values


class DistillProblem(NamedTuple):
    """What does not change during a distillation.

    Attributes:
        config: how.
        views: batches, one a view that teaches something.
        rows: of the grid's table that train; None without a grid.
    """

    config: DistillConfig
    views: list[DistillBatch]
    rows: Int[np.ndarray, "used"] | None


class DistillState(eqx.Module):
    """What a distillation goes on from, to the same bits.

    Attributes:
        field: what is learned; of a grid, the entries that train.
        optimizer: what the step carries along.
        step: how many steps were made.
    """

    field: FeatureField
    optimizer: Any
    step: int


class Distilled(NamedTuple):
    """A distillation after one more step.

    Attributes:
        state: to go on from. Its arrays are given away in the next step: copy what is to be kept.
        info: losses of this step, on the device.
        seconds: that it took, without what compiled.
        compile_seconds: that compiling took in it.
    """

    state: DistillState
    info: dict[str, Array]
    seconds: float
    compile_seconds: float


def begin_distill(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    teacher: Teacher,
    config: DistillConfig,
    rasterize_mode: str = "classic",
) -> tuple[DistillProblem, DistillState]:
    """A distillation before its first step.

    Args:
        gaussians: the scene, which stays as it is.
        cameras: one a view, viewmat [4,4] and K [3,3], of any sizes.
        teacher: of the same views.
        config: how.
        rasterize_mode: "antialiased" for a scene that was fitted so.

    Raises:
        ValueError: the teacher has other views, or of other sizes, or the scene no Gaussian with a place.
    """
    _check(cameras, teacher)
    field, located = init_field(jax.random.key(config.seed), config, gaussians.means, teacher.dimension)
    field, located, rows = used_part(field, located)
    frozen, views = frozen_views(gaussians, cameras, rasterize_mode), []
    most = most_rows(teacher)
    for v, (view, plan) in enumerate(frozen):
        if teacher.maps is None and not (teacher.ids[v] >= 0).any():
            continue  # it teaches nothing
        ids, codebook = of_view(teacher, v, most)
        codebook = None if codebook is None else jnp.asarray(codebook)
        of_pixels = None if teacher.maps is None else teacher.maps[v]
        views.append(DistillBatch(view, located, jnp.asarray(ids), codebook, of_pixels, plan))
    state = DistillState(field, distill_step(config).init(field), 0)
    return DistillProblem(config, views, rows), state


def distill(problem: DistillProblem, state: DistillState) -> Iterator[Distilled]:
    """Step by step, until all is done. The same state and problem give the same bits, wherever the
    distillation was begun or resumed."""
    config = problem.config
    advance = compiled_step(config)
    key = jax.random.fold_in(jax.random.key(config.seed), _PATCHES)
    field, optimizer = state.field, state.optimizer
    for i in range(state.step, config.iterations):
        begun, programs = perf_counter(), advance._cache_size()
        batch = problem.views[shuffled_index(config.seed, i, len(problem.views))]
        field, optimizer, info = advance(field, optimizer, batch, jnp.asarray(i), jax.random.fold_in(key, i))
        jax.block_until_ready(info)
        seconds, new = perf_counter() - begun, advance._cache_size() > programs
        now = DistillState(field, optimizer, i + 1)
        yield Distilled(now, info, 0.0 if new else seconds, seconds if new else 0.0)


def finished(problem: DistillProblem, state: DistillState) -> FeatureField:
    """The field for any place, not only where the scene's Gaussians are."""
    return whole(state.field, problem.rows)


def frozen_views(
    gaussians: Gaussians, cameras: Sequence[Camera], rasterize_mode: str = "classic"
) -> list[tuple[FrozenView, Plan]]:
    """The scene in each camera. Those of one size share their plan and the lengths of their lists.

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


@lru_cache(maxsize=2)
def compiled_step(config: DistillConfig) -> Callable:
    """The jitted step: field, optimizer, batch, number, key. Buffers that it replaces are given away."""
    step = distill_step(config)

    @partial(jax.jit, compiler_options=host_options(), donate_argnums=(0, 1))
    def advance(field, optimizer, batch, i, key):
        return step.update(field, optimizer, batch, step=i, key=key)

    return advance


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
