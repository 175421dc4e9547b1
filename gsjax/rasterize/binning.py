"""The tiles that each Gaussian touches, and each tile's list from front to back.

Gaussians are ranked by depth. Each is expanded to the rows of tiles that its ellipse crosses, and in every
row to the range of columns that it covers, so the number of pairs is known before they are laid out. They
include every tile where the Gaussian reaches alpha_min at a pixel's centre, and a few where it does so only
between centres or within rounding. Pairs are then sorted by tile, stably. Lists can have any length: only
their total is bounded.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.rasterize.lanes import slots
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import Projected
from gsjax.rasterize.sorting import argsort_keys, lists, repeat, running_sum

_TOO_MANY = 2**30  # above this an int32 running sum is no longer trusted
_COUNTED = 2**16  # rows that are counted together when a plan is made


class TileLists(NamedTuple):
    """Lists of all tiles of one camera, concatenated in `ids`."""

    ids: Int[Array, "capacity"]  # Gaussians, by tile, front to back
    starts: Int[Array, "tiles"]
    counts: Int[Array, "tiles"]
    pairs: Int[Array, ""]  # Gaussian-tile pairs that are drawn
    needed: Int[Array, ""]  # the capacity that is needed
    overflow: Bool[Array, ""]


class _Spans(NamedTuple):
    """One Gaussian in one row of tiles: the columns it covers there."""

    gaussian_rank: Int[Array, "rows lanes"]
    first_tile: Int[Array, "rows lanes"]
    count: Int[Array, "rows lanes"]  # columns; 0 in an unused slot


def bin_gaussians(projected: Projected, tile_mask: Bool[Array, "tiles"] | None, plan: Plan) -> TileLists:
    """Front-to-back lists of every tile of one camera.

    Equal depths keep the order of the input. Tiles outside `tile_mask`, if given, get empty lists.
    """
    projected = jax.lax.stop_gradient(projected)
    by_depth = depth_order(projected, plan)
    first_row, num_rows = tile_rows(projected, tile_mask, plan)
    first_row, num_rows = first_row[by_depth], num_rows[by_depth]
    rows = total(num_rows)
    enough_rows = rows <= plan.capacity // 2
    num_rows = jnp.where(enough_rows, num_rows, 0)
    in_order = [column[by_depth] for column in _ellipses(projected)]
    laid_out = _lay_out(in_order, first_row, num_rows, plan)
    slot = slots(plan.capacity // 2)
    rank = _rank_of(slot, laid_out.starts, plan)
    spans = _spans(tile_mask, laid_out, slot, rank, plan)
    pairs = total(spans.count)
    overflow = ~enough_rows | (pairs > plan.capacity)
    needed = jnp.where(enough_rows, jnp.maximum(pairs, 2 * rows), _bounding_pairs(projected, plan))
    count = jnp.where(overflow, 0, spans.count)  # a call that overflowed draws nothing and reports it
    entries = (a.ravel() for a in (spans.gaussian_rank, spans.first_tile, count))
    ranks, edges = lists(*entries, len(by_depth), plan.num_tiles, slots(plan.capacity).size, plan.sort)
    counts = edges[1:] - edges[:-1]
    if tile_mask is not None:
        counts = jnp.where(tile_mask, counts, 0)
    if plan.max_per_tile is not None:
        counts = jnp.minimum(counts, plan.max_per_tile)
    return TileLists(
        ids=by_depth[ranks],
        starts=edges[:-1],
        counts=counts,
        pairs=counts.sum(dtype=jnp.int32),
        needed=needed,
        overflow=overflow,
    )


def needed_capacity(
    projected: Projected, tile_mask: Bool[Array, "tiles"] | None, plan: Plan
) -> Int[Array, ""]:
    """The capacity that `bin_gaussians` needs; the largest int32 if it cannot be counted. The plan's own
    capacity does not matter: rows are counted a few at a time, by one program for all capacities.

    Args:
        projected: Gaussians projected into the camera.
        tile_mask: tiles that are drawn (default: all).
        plan: options.
    """
    first_row, num_rows = tile_rows(projected, tile_mask, plan)
    rows = total(num_rows)
    num_rows = jnp.where(rows > _TOO_MANY // 2, 0, num_rows)
    laid_out = _lay_out(_ellipses(projected), first_row, num_rows, plan)

    def count(state):
        first, pairs = state
        slot = slots(_COUNTED)
        rank = _rank_of(slot, jnp.maximum(laid_out.starts - first, 0), plan)
        spans = _spans(tile_mask, laid_out, slot + first, rank, plan)
        more = pairs + spans.count.sum(dtype=jnp.int32)
        return first + _COUNTED, jnp.where(pairs > _TOO_MANY, jnp.iinfo(jnp.int32).max, more)

    start = (jnp.int32(0), jnp.int32(0))
    _, pairs = jax.lax.while_loop(lambda state: state[0] < laid_out.total, count, start)
    return jnp.maximum(pairs, doubled(rows))


def total(counts: Int[Array, "*n"]) -> Int[Array, ""]:
    """Sum that saturates at the largest int32: real scenes have reached 2.2e9 pairs."""
    estimate = counts.astype(jnp.float32).sum()
    return jnp.where(estimate > _TOO_MANY, jnp.iinfo(jnp.int32).max, counts.sum(dtype=jnp.int32))


def doubled(rows: Int[Array, "*n"]) -> Int[Array, "*n"]:
    """Twice the rows, or the largest int32.

    Args:
        rows: numbers of rows, 0 or more.
    """
    return jnp.where(rows > _TOO_MANY // 2, jnp.iinfo(jnp.int32).max, 2 * rows)


def depth_order(projected: Projected, plan: Plan) -> Int[Array, "n"]:
    """Visible Gaussians by depth, then the others."""
    depths = jnp.where(projected.visible, projected.depths, jnp.inf)
    if depths.dtype != jnp.float32:
        return jnp.argsort(depths, stable=True).astype(jnp.int32)
    # Non-negative floats have the same order as their bits.
    return argsort_keys(jax.lax.bitcast_convert_type(depths, jnp.uint32), plan.sort)


def _tile_of(position: Array, plan: Plan, limit: int) -> Int[Array, "*n"]:
    """Index of the tile at a pixel position, from -1 to `limit`."""
    # Clipped as floats: an int32 cannot hold every float.
    return jnp.clip(jnp.floor(position / plan.tile_size), -1, limit).astype(jnp.int32)


def _box(projected: Projected, axis: int, plan: Plan) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    """First tile and one past the last of each bounding box along an axis (0: x); equal if not visible."""
    limit = (plan.tiles_x, plan.tiles_y)[axis]
    mean, half = projected.means2d[:, axis], projected.extents[:, axis]
    low = jnp.maximum(_tile_of(mean - half, plan, limit), 0)
    high = jnp.minimum(_tile_of(mean + half, plan, limit) + 1, limit)
    return low, jnp.where(projected.visible, jnp.maximum(high, low), low)


def tile_rows(projected: Projected, tile_mask, plan: Plan) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
    """First row of tiles and number of rows of each Gaussian; no rows if it touches no tile of the mask."""
    top, bottom = _box(projected, 1, plan)
    if tile_mask is None:
        return top, bottom - top
    left, right = _box(projected, 0, plan)
    grid = tile_mask.reshape(plan.tiles_y, plan.tiles_x).astype(jnp.int32)
    wanted = jnp.pad(grid.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    inside = wanted[bottom, right] - wanted[top, right] - wanted[bottom, left] + wanted[top, left]
    return top, jnp.where(inside > 0, bottom - top, 0)


def _bounding_pairs(projected: Projected, plan: Plan) -> Int[Array, ""]:
    """An upper bound on the needed capacity, from bounding boxes alone."""
    (left, right), (top, bottom) = _box(projected, 0, plan), _box(projected, 1, plan)
    columns, rows = right - left, bottom - top
    return jnp.maximum(total(columns * rows), doubled(total(rows)))


class _Rows(NamedTuple):
    """Rows of tiles of all Gaussians, one Gaussian after another."""

    ellipses: list[Float[Array, "n"]]  # from `_ellipses`, in the order in which rows are laid out
    shift: Int[Array, "n"]  # a slot's row of tiles is the slot plus this
    starts: Int[Array, "n"]  # where each Gaussian's rows start
    total: Int[Array, ""]


def _lay_out(ellipses, first_row, num_rows, plan: Plan) -> _Rows:
    ends = running_sum(num_rows, plan.sort)
    starts = ends - num_rows
    return _Rows(ellipses, first_row - starts, starts, ends[-1])


def _rank_of(slot, starts, plan: Plan):
    """The rank of the Gaussian to which each slot belongs; the slots of each Gaussian begin at `starts`."""
    ranks = jnp.arange(starts.shape[0], dtype=jnp.int32)
    return repeat(ranks, starts, slot.size, plan.sort).reshape(slot.shape)


def _spans(tile_mask, laid_out: _Rows, slot, rank, plan: Plan) -> _Spans:
    """The columns that Gaussians cover in their rows.

    Args:
        tile_mask: tiles that are drawn (default: all).
        laid_out: the rows of all Gaussians.
        slot: some of these rows.
        rank: which Gaussian each belongs to, in the order in which they are laid out.
        plan: options.
    """
    row = slot + laid_out.shift[rank]
    low, high = _columns_in_row([column[rank] for column in laid_out.ellipses], row, plan)
    count = jnp.where(slot < laid_out.total, jnp.maximum(high - low, 0), 0)
    if tile_mask is not None:
        grid = tile_mask.reshape(plan.tiles_y, plan.tiles_x).astype(jnp.int32)
        before = jnp.pad(jnp.cumsum(grid, axis=1), ((0, 0), (1, 0))).ravel()
        line = jnp.clip(row, 0, plan.tiles_y - 1) * (plan.tiles_x + 1)
        count = jnp.where(before[line + jnp.maximum(high, low)] > before[line + low], count, 0)
    return _Spans(gaussian_rank=rank, first_tile=row * plan.tiles_x + low, count=count)


def _columns_in_row(ellipses, row, plan: Plan):
    """First column of tiles and one past the last where alpha reaches alpha_min at pixel centres of a row.

    The ellipse A dx^2 + 2 B dx dy + C dy^2 = t, t = 2 ln(o / alpha_min), reaches furthest to the right at
    dy = -(B/C) h_x, and its reach is a concave function of dy; so within a band of rows it reaches furthest
    at the nearest dy of the band, and likewise to the left. At dy it spans
    -(B/A) dy +- sqrt(t/A (1 - (dy/h_y)^2)).
    """
    u, v, half_x, half_y, a, b, c, opacity = ellipses
    tiny = jnp.finfo(a.dtype).tiny  # a conic with an underflowed entry is flat in that direction
    level = 2 * jnp.log(jnp.maximum(opacity / plan.alpha_min, 1.0))
    level = level * 1.0002 + 1e-3  # compositing decides exactly: rounding errs towards keeping pairs
    furthest, slope = -b / jnp.maximum(c, tiny) * half_x, -b / jnp.maximum(a, tiny)
    width = jnp.sqrt(level / jnp.maximum(a, tiny))
    top = row * plan.tile_size + 0.5 - v
    low, high = jnp.maximum(top, -half_y), jnp.minimum(top + (plan.tile_size - 1), half_y)

    def reach(dy):
        return width * jnp.sqrt(jnp.maximum(1 - (dy / half_y) ** 2, 0.0))

    at_right, at_left = jnp.clip(furthest, low, high), jnp.clip(-furthest, low, high)
    slack = 1e-3 + 16 * jnp.finfo(u.dtype).eps * (jnp.abs(u) + half_x)
    right = u + jnp.minimum(slope * at_right + reach(at_right), half_x) + slack
    left = u + jnp.maximum(slope * at_left - reach(at_left), -half_x) - slack
    # Pixel centres between left and right, and the tiles that hold them.
    first = jnp.clip(jnp.ceil(left - 0.5), 0, plan.tiles_x * plan.tile_size)
    last = jnp.clip(jnp.floor(right - 0.5), -1, plan.tiles_x * plan.tile_size - 1)
    empty = (low > high) | (first > last)
    start = _tile_of(first, plan, plan.tiles_x)
    return start, jnp.where(empty, start, _tile_of(last, plan, plan.tiles_x) + 1)


def _ellipses(projected: Projected) -> list[Float[Array, "n"]]:
    """u, v, h_x, h_y, the conic's A, B, C and the opacity of every Gaussian."""
    columns = [projected.means2d, projected.extents, projected.conics]
    return [a[:, i] for a in columns for i in range(a.shape[1])] + [projected.opacities]
