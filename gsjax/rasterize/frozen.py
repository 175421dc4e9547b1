"""Views of Gaussians that stand still: projected and listed once, painted as often as their values change.

Where values alone train, as features do on a scene that somebody else has fitted, a render would project,
sort and list the same Gaussians in every step. What it finds is kept here instead, 28 bytes a Gaussian that
the view shows and 4 a pair. Those that it does not show, for they are beside it or behind others, need no
values. An image of many channels need not be there as a whole either: a strip of its tile rows can be
painted, and used up, after the other.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from gsjax.rasterize.binning import bin_gaussians
from gsjax.rasterize.compositing import Lists, Splats, untile
from gsjax.rasterize.gradients import composite
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import project_gaussians
from gsjax.rasterize.rasterization import plan as _plan

_OF_ROWS = ("rows", "means2d", "conics", "opacities")  # of a view, one for each Gaussian that it shows


class FrozenView(NamedTuple):
    """What a camera sees of N Gaussians, whatever they are painted with; or a strip of it.

    Attributes:
        rows: which of the N are shown, in the order in which tiles list them.
        means2d, conics, opacities: of these, as projected, in pixels of the image or of the strip.
        ids: places in `rows`, of all tiles' lists, front to back, no further than they are read.
        starts, counts: of each tile's list in `ids`.
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
    **options: Any,
) -> tuple[FrozenView, Plan]:
    """The views [C, ...] of C cameras, and the plan that they are painted with. On the host.

    Arguments as for `gsjax.rasterization`, its options too; gradients stop here. Gaussians that cannot be
    drawn are in no list.

    Raises:
        ValueError: as `gsjax.plan`.
    """
    scene = (means, quats, scales, opacities)
    plan = _plan(*scene, viewmats, Ks, width, height, headroom=1.0, **options)
    frozen = [_freeze(*scene, viewmat, K, plan) for viewmat, K in zip(viewmats, Ks, strict=True)]
    if any(bool(overflow) for _, overflow in frozen):
        raise RuntimeError("a plan that was made for these views did not hold them; please report this")
    shown = [_shown(jax.device_get(view)) for view, _ in frozen]
    seen, pairs = (max(1, *(len(getattr(view, name)) for view in shown)) for name in ("rows", "ids"))
    views = [filled_up(view, seen, pairs) for view in shown]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *views), plan


def filled_up(view: FrozenView, seen: int, pairs: int) -> FrozenView:
    """One view with longer `rows` and `ids`, so that views can be stacked: by the first of the N Gaussians,
    which no tile lists for it. On the host.

    Args:
        view: of one camera.
        seen: length that `rows` and what goes with it are to have.
        pairs: length that `ids` is to have.
    """

    def more(a: np.ndarray, length: int) -> np.ndarray:
        return np.concatenate([a, np.zeros((length - len(a), *a.shape[1:]), a.dtype)])

    view = jax.device_get(view)
    of_rows = {name: more(getattr(view, name), seen) for name in _OF_ROWS}
    return view._replace(**of_rows, ids=more(view.ids, pairs))


def rows_within(megabytes: float, numbers: int, plan: Plan) -> int:
    """Rows of tiles in a strip whose pixels, with so many numbers each, take no more memory; one at least.

    Args:
        megabytes: what the pixels of a strip may take.
        numbers: floats a pixel, of 4 bytes.
        plan: of the view.
    """
    a_row = 4 * numbers * plan.tile_size * plan.width
    return int(max(1, min(plan.tiles_y, megabytes * 2**20 // a_row)))


def strip_of(view: FrozenView, plan: Plan, first: Int[Array, ""] | int, rows: int) -> tuple[FrozenView, Plan]:
    """`rows` rows of tiles of one view, from `first` on, and their plan; below the image they are empty."""
    wide = plan.tiles_x

    def cut(a):
        padded = jnp.pad(a, (0, rows * wide))  # a slice that would reach beyond begins earlier instead
        return jax.lax.dynamic_slice_in_dim(padded, first * wide, rows * wide)

    down = jnp.stack([jnp.zeros(()), first * plan.tile_size]).astype(view.means2d.dtype)
    part = view._replace(means2d=view.means2d - down, starts=cut(view.starts), counts=cut(view.counts))
    return part, dataclasses.replace(plan, height=rows * plan.tile_size)


def paint(
    view: FrozenView, values: Float[Array, "n d"], plan: Plan
) -> tuple[Float[Array, "height width d"], Float[Array, "height width"]]:
    """The image of one view, sum_i w_i v_i without background, and its alphas. Differentiable by the values,
    which are those of all Gaussians.

    The weights are those of `gsjax.rasterization`, so the image is too.
    """
    return paint_shown(view, values[view.rows], plan)


def paint_shown(
    view: FrozenView, values: Float[Array, "seen d"], plan: Plan
) -> tuple[Float[Array, "height width d"], Float[Array, "height width"]]:
    """As `paint`, with the values of `view.rows` alone."""
    view = jax.lax.stop_gradient(view)
    splats = Splats(view.means2d, view.conics, view.opacities, values)
    lists = Lists(view.ids, view.starts, view.counts)
    tiles, transmittance, _ = composite(splats, lists, None, plan)
    return untile(tiles, (), plan), 1 - untile(transmittance[:, None], (), plan)[..., 0]


def _shown(view: FrozenView) -> FrozenView:
    """Without the Gaussians that no list has, and lists one after another. On the host."""
    counts, total = view.counts, int(view.counts.sum())
    starts = np.cumsum(counts) - counts
    ids = view.ids[np.repeat(view.starts - starts, counts) + np.arange(total)]
    there, first, place = np.unique(ids, return_index=True, return_inverse=True)
    order = np.argsort(first)  # tile by tile: what is painted together lies together
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
def _freeze(means, quats, scales, opacities, viewmat, K, plan: Plan) -> tuple[FrozenView, Bool[Array, ""]]:
    usable = jnp.ones(len(means), bool)
    projected = project_gaussians(means, quats, scales, opacities, usable, viewmat, K, plan)
    binned = bin_gaussians(projected, None, plan)
    splats = Splats(projected.means2d, projected.conics, projected.opacities, jnp.ones((len(means), 1)))
    *_, reads = composite(splats, Lists(binned.ids, binned.starts, binned.counts), None, plan)
    shapes = (projected.means2d, projected.conics, projected.opacities)
    return FrozenView(jnp.arange(len(means)), *shapes, binned.ids, binned.starts, reads), binned.overflow
