"""The views of a distillation: the frozen scene as each camera sees it, with its teacher."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.distill.teacher import Teacher, view_codebook
from gsjax.rasterize.frozen import FrozenView, freeze_views
from gsjax.rasterize.plan import Plan
from gsjax.scene.feature_grid import Located
from gsjax.scene.gaussians import Gaussians


class Batch(NamedTuple):
    """A view and its teacher.

    Attributes:
        view: the static scene in the view's camera.
        located: locations of its Gaussians in the grid; None without one.
        ids: row of the codebook, or object, of each pixel; -1 where unknown.
        codebook: the teacher's features in this view; None for a teacher of maps only.
        map: the teacher's feature map, of any resolution; None without. It stays on the host until its step.
        plan: plan of the view, which never grows, as the view is frozen.
        begun: the step at which gradient descent began.
    """

    view: FrozenView
    located: Located | None
    ids: Int[Array, "height width"]
    codebook: Float[Array, "k d"] | None
    map: Float[Array, "h w d"] | None
    plan: Plan
    begun: Int[Array, ""] | int = 0


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


def in_basis(batch: Batch, basis: Float[Array, "d r"]) -> Batch:
    """The batch with the teacher's features in the channels of a basis.

    Args:
        batch: the view and its teacher.
        basis: orthonormal columns.
    """
    codebook, pixels = (
        None if features is None else jnp.matmul(jnp.asarray(features), basis, precision="highest")
        for features in (batch.codebook, batch.map)
    )
    return batch._replace(located=None, codebook=codebook, map=pixels)


def check_views(cameras: Sequence[Camera], teacher: Teacher) -> None:
    """Raises ValueError if a teacher's views differ from the cameras in number or size."""
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


def resized_rows(
    teacher: Float[Array, "h w d"], first: Int[Array, ""] | int, rows: int, plan: Plan
) -> Float[Array, "rows width d"]:
    """Rows of a teacher's map resized bilinearly to the view.

    Args:
        teacher: the map.
        first: the first row.
        rows: number of rows.
        plan: of the view, with its size.
    """
    high, wide = teacher.shape[:2]

    def places(centres, have: int, want: int):
        at = jnp.clip(centres * (have / want) - 0.5, 0, have - 1)
        low = jnp.minimum(at.astype(jnp.int32), have - 1)
        return low, jnp.minimum(low + 1, have - 1), at - low

    top, bottom, down = places(first + jnp.arange(rows) + 0.5, high, plan.height)
    left, right, across = places(jnp.arange(plan.width) + 0.5, wide, plan.width)
    lines = teacher[top] * (1 - down)[:, None, None] + teacher[bottom] * down[:, None, None]
    return lines[:, left] * (1 - across)[:, None] + lines[:, right] * across[:, None]
