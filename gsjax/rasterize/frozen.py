"""Views of fixed Gaussians: projected and listed once, painted as often as their values change.

When only values are trained, such as features on an already fitted scene, rendering would project, sort and
list the same Gaussians in every step. Here the result is stored instead, with 28 bytes per Gaussian that the
view shows and 4 per pair. Gaussians that it does not show, because they are outside or occluded, need no
values. Nor does an image of many channels have to exist as a whole: it can be painted and consumed strip by
strip, in rows of tiles.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.compositing import Lists, Splats
from gsjax.rasterize.gradients import composite
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians
from gsjax.rasterize.rasterization import plan as _plan
from gsjax.rasterize.tiles import split_views, untile

_OF_ROWS = ("rows", "means2d", "conics", "opacities")  # fields with one entry per Gaussian that is shown


class FrozenView(NamedTuple):
    """A camera's view of N Gaussians, independent of the values they are painted with; or a strip of it.

    Attributes:
        rows: which of the N are shown, in the order in which the tiles list them.
        means2d, conics, opacities: their projections, in pixels of the image or of the strip.
        ids: indices into `rows`: the lists of all tiles, front to back, cut off where reading stops.
        starts, counts: start and length of each tile's list in `ids`.
    """

    rows: Int[Array, "*views seen"]
    means2d: Float[Array, "*views seen 2"]
    conics: Float[Array, "*views seen 3"]
    opacities: Float[Array, "*views seen"]
    ids: Int[Array, "*views pairs"]
    starts: Int[Array, "*views tiles"]
    counts: Int[Array, "*views tiles"]


def freeze_views(
    means: Float[Array, "n 3"],
    quats: Float[Array, "n 4"],
    scales: Float[Array, "n 3"],
    opacities: Float[Array, "n"],
    viewmats: Float[Array, "c 4 4"],
    Ks: Float[Array, "c 3 3"],
    width: int,
    height: int,
    *,
    fisheye: Float[Array, "c 4"] | None = None,
    **options: Any,
) -> tuple[FrozenView, Plan]:
    """The views [C, ...] of C cameras, and the plan that they are painted with. On the host.

    Arguments as for `gsjax.rasterization`, including the options of its plan; gradients stop here. Gaussians
    that cannot be drawn are in no list.

    Raises:
        ValueError: there are no Gaussians; or as `gsjax.plan`.
        RuntimeError: the plan is too small for the views, which is a bug.
    """
    if len(means) == 0:
        raise ValueError("means: expected at least one Gaussian to see, found none")
    scene = (means, quats, scales, opacities)
    plan = _plan(*scene, viewmats, Ks, width, height, headroom=1.0, fisheye=fisheye, **options)
    dtype = jnp.result_type(*scene, viewmats, Ks, jnp.float32)  # half is seen in single, as by `plan`
    scene = tuple(jnp.asarray(array, dtype) for array in scene)
    cameras = zip(
        *map(np.asarray, (viewmats, Ks) if fisheye is None else (viewmats, Ks, fisheye)), strict=True
    )
    frozen = [_freeze(*scene, *camera, plan=plan) for camera in cameras]
    if any(bool(overflow) for _, overflow in frozen):
        raise RuntimeError("the plan made for these views is too small for them; please report this as a bug")
    shown = [_compacted(jax.device_get(view)) for view, _ in frozen]
    seen, pairs = (max(1, *(len(getattr(view, name)) for view in shown)) for name in ("rows", "ids"))
    views = [padded_view(view, seen, pairs) for view in shown]
    return jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *views)), plan


def padded_view(view: FrozenView, seen: int, pairs: int) -> FrozenView:
    """One view with `rows` and `ids` padded with zeros, so that views can be stacked; no tile lists the
    padding. On the host.

    Args:
        view: the view of one camera.
        seen: wanted length of `rows` and of the fields that go with it.
        pairs: wanted length of `ids`.
    """

    def more(a: np.ndarray, length: int) -> np.ndarray:
        return np.concatenate([a, np.zeros((length - len(a), *a.shape[1:]), a.dtype)])

    view = jax.device_get(view)
    of_rows = {name: more(getattr(view, name), seen) for name in _OF_ROWS}
    return view._replace(**of_rows, ids=more(view.ids, pairs))


def rows_within(megabytes: float, numbers: int, plan: Plan) -> int:
    """Number of tile rows in a strip whose pixels fit into the given memory; at least one.

    Args:
        megabytes: memory for the pixels of a strip, in MiB.
        numbers: floats per pixel, of 4 bytes each.
        plan: plan of the view.
    """
    a_row = 4 * numbers * plan.tile_size * plan.width
    return int(max(1, min(plan.tiles_y, megabytes * 2**20 // a_row)))


def strip_of(view: FrozenView, plan: Plan, first: Int[Array, ""] | int, rows: int) -> tuple[FrozenView, Plan]:
    """A strip of `rows` tile rows of a view, starting at row `first`, and its plan; empty below the image."""
    wide = plan.tiles_x

    def cut(a):
        padded = jnp.pad(a, (0, rows * wide))  # otherwise a slice that reaches beyond the end starts earlier
        return jax.lax.dynamic_slice_in_dim(padded, first * wide, rows * wide)

    down = jnp.stack([jnp.zeros(()), first * plan.tile_size]).astype(view.means2d.dtype)
    part = view._replace(means2d=view.means2d - down, starts=cut(view.starts), counts=cut(view.counts))
    return part, dataclasses.replace(plan, height=rows * plan.tile_size)


@partial(jax.jit, static_argnames="plan", inline=True)
def paint(
    view: FrozenView, values: Float[Array, "n d"], plan: Plan
) -> tuple[Float[Array, "height width d"], Float[Array, "height width"]]:
    """The image of one view, sum_i w_i v_i without background, and its alphas. Differentiable in the values
    of all Gaussians.

    The weights, and therefore the image, are those of `gsjax.rasterization`.
    """
    return paint_shown(view, values[view.rows], plan)


@partial(jax.jit, static_argnames="plan", inline=True)
def paint_shown(
    view: FrozenView, values: Float[Array, "seen d"], plan: Plan
) -> tuple[Float[Array, "height width d"], Float[Array, "height width"]]:
    """As `paint`, with values for `view.rows` only."""
    view = jax.lax.stop_gradient(view)
    splats = Splats(view.means2d, view.conics, view.opacities, values)
    lists = Lists(view.ids, view.starts, view.counts)
    image, transmittance, _ = composite(splats, lists, None, plan)
    alphas = 1 - untile(transmittance[:, None], plan)
    return split_views(image, (), plan), split_views(alphas, (), plan)[..., 0]


def _compacted(view: FrozenView) -> FrozenView:
    """The view without unlisted Gaussians, with its lists packed one after another. On the host."""
    counts, total = view.counts, int(view.counts.sum())
    starts = np.cumsum(counts) - counts
    ids = view.ids[np.repeat(view.starts - starts, counts) + np.arange(total)]
    there, first, place = np.unique(ids, return_index=True, return_inverse=True)
    order = np.argsort(first)  # tile by tile, so that Gaussians painted together are adjacent in memory
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    rows = there[order]
    return FrozenView(
        rows.astype(np.int32),
        *(getattr(view, name)[rows] for name in _OF_ROWS[1:]),
        rank[place].astype(np.int32),
        starts.astype(np.int32),
        counts,
    )


@partial(jax.jit, static_argnames="plan")
def _freeze(
    means, quats, scales, opacities, viewmat, K, fisheye=None, *, plan: Plan
) -> tuple[FrozenView, Bool[Array, ""]]:
    usable = jnp.ones(len(means), bool)
    projected = project_gaussians(means, quats, scales, opacities, usable, viewmat, K, plan, None, fisheye)
    binned = bin_gaussians(projected, None, plan)
    splats = Splats(projected.means2d, projected.conics, projected.opacities, jnp.ones((len(means), 1)))
    *_, reads = composite(splats, Lists(binned.ids, binned.starts, binned.counts), None, plan)
    shapes = (projected.means2d, projected.conics, projected.opacities)
    return FrozenView(jnp.arange(len(means)), *shapes, binned.ids, binned.starts, reads), binned.overflow
