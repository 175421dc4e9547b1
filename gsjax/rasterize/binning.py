"""Which tiles a Gaussian touches, and each tile's list from front to back.

Gaussians are ranked by depth, expanded to (tile, rank) pairs over the tiles of their bounding box, tested
exactly against each tile, and sorted by tile. Lists have any length: nothing but the total is bounded.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from gsjax.rasterize.plan import TILE, Plan
from gsjax.rasterize.projection import ALPHA_MIN, Projected

_TOO_MANY = 2**30  # above this an int32 running sum is no longer trusted


class TileLists(NamedTuple):
    """Lists of all tiles of one camera, one after the other in `ids`."""

    ids: Int[Array, "capacity"]  # Gaussians, by tile, front to back
    starts: Int[Array, "tiles"]
    counts: Int[Array, "tiles"]
    pairs: Int[Array, ""]  # Gaussian-tile pairs that are drawn
    needed: Int[Array, ""]  # pairs that had to be laid out first: what the capacity must hold
    overflow: Bool[Array, ""]


def _boxes(projected: Projected, plan: Plan) -> tuple[Int[Array, "n 2"], Int[Array, "n 2"]]:
    """First tile (x, y) and number of tiles (x, y) of each Gaussian's bounding box; none if not visible."""
    limit = jnp.array([plan.tiles_x, plan.tiles_y])
    mean, half = jax.lax.stop_gradient((projected.means2d, projected.extents))

    def tile_of(position):  # clipped as floats: an int32 cannot hold every float
        return jnp.clip(jnp.floor(position / TILE), -1, limit).astype(jnp.int32)

    low = jnp.maximum(tile_of(mean - half), 0)
    high = jnp.minimum(tile_of(mean + half) + 1, limit)
    return low, jnp.where(projected.visible[:, None], jnp.maximum(high - low, 0), 0)


def _total(counts: Int[Array, "n"]) -> Int[Array, ""]:
    """Sum that saturates at the largest int32: 2.2e9 pairs have been seen in the wild."""
    estimate = counts.astype(jnp.float32).sum()
    return jnp.where(estimate > _TOO_MANY, jnp.iinfo(jnp.int32).max, counts.sum(dtype=jnp.int32))


def count_pairs(projected: Projected, plan: Plan) -> Int[Array, ""]:
    """The capacity that `bin_gaussians` needs."""
    _, size = _boxes(projected, plan)
    return _total(size[:, 0] * size[:, 1])


def _touches(mean, conic, opacity, tile_x, tile_y) -> Bool[Array, "pairs"]:
    """Whether alpha reaches 1/255 anywhere on the tile: an exact test on the rectangle of its pixel centres.

    The least of a convex quadratic over a rectangle lies, when its centre is outside, on one of the (at most
    two) edges that face the centre, and along an edge it is a clamped one-dimensional minimum.
    """
    a, b, c = conic
    low_x, low_y = tile_x * TILE + 0.5 - mean[0], tile_y * TILE + 0.5 - mean[1]
    high_x, high_y = low_x + (TILE - 1), low_y + (TILE - 1)
    edge_x = jnp.clip(0.0, low_x, high_x)
    edge_y = jnp.clip(0.0, low_y, high_y)

    def form(dx, dy):  # less what its terms, which may cancel, can have lost to rounding
        squares = a * dx * dx + c * dy * dy
        return squares + 2 * b * dx * dy - rounding * squares

    rounding = 8 * jnp.finfo(a.dtype).eps
    tiny = jnp.finfo(a.dtype).tiny  # a conic whose entry has underflown is flat that way
    on_vertical = form(edge_x, jnp.clip(-b * edge_x / jnp.maximum(c, tiny), low_y, high_y))
    on_horizontal = form(jnp.clip(-b * edge_y / jnp.maximum(a, tiny), low_x, high_x), edge_y)
    least = jnp.minimum(
        jnp.where(edge_x == 0, jnp.inf, on_vertical), jnp.where(edge_y == 0, jnp.inf, on_horizontal)
    )
    least = jnp.where((edge_x == 0) & (edge_y == 0), 0.0, least)
    # The pixels have the last word, so rounding here errs to the side of keeping.
    return least <= 2 * jnp.log(opacity / ALPHA_MIN) * 1.001 + 1e-3


def bin_gaussians(projected: Projected, tile_mask: Bool[Array, "tiles"] | None, plan: Plan) -> TileLists:
    """Front-to-back lists of every tile of one camera.

    Equal depths keep the order of the input. Tiles outside `tile_mask`, where there is one, get empty lists.
    """
    capacity, num_tiles = plan.capacity, plan.num_tiles
    n = projected.depths.shape[0]
    low, size = _boxes(projected, plan)
    depths = jax.lax.stop_gradient(projected.depths)
    by_depth = jnp.argsort(jnp.where(projected.visible, depths, jnp.inf), stable=True).astype(jnp.int32)
    per_gaussian = (size[:, 0] * size[:, 1])[by_depth]
    needed = _total(per_gaussian)
    overflow = needed > capacity
    per_gaussian = jnp.where(overflow, 0, per_gaussian)  # a call that overflowed draws nothing, and says so

    # Expand each Gaussian to its tiles.
    ends = jnp.cumsum(per_gaussian)
    slot = jnp.arange(capacity, dtype=jnp.int32)
    rank = jnp.repeat(jnp.arange(n, dtype=jnp.int32), per_gaussian, total_repeat_length=capacity)
    gaussian = by_depth[rank]
    within = slot - (ends - per_gaussian)[rank]
    columns = jnp.maximum(size[:, 0], 1)[gaussian]
    tile_x = low[gaussian, 0] + within % columns
    tile_y = low[gaussian, 1] + within // columns

    # Keep the pairs that are real, whose ellipse reaches the tile, and whose tile is asked for.
    drawn_with = (projected.means2d, projected.conics, projected.opacities)
    mean, conic, opacity = jax.lax.stop_gradient(drawn_with)
    keep = slot < ends[-1]
    keep &= _touches(
        (mean[:, 0][gaussian], mean[:, 1][gaussian]),
        tuple(conic[:, i][gaussian] for i in range(3)),
        opacity[gaussian],
        tile_x,
        tile_y,
    )
    tile = tile_y * plan.tiles_x + tile_x
    if tile_mask is not None:
        keep &= tile_mask[jnp.clip(tile, 0, num_tiles - 1)]
    tile = jnp.where(keep, tile, num_tiles)

    tile, gaussian = _sort_by_tile(tile, rank, by_depth, num_tiles, n)
    edges = jnp.searchsorted(tile, jnp.arange(num_tiles + 1, dtype=tile.dtype)).astype(jnp.int32)
    return TileLists(
        ids=gaussian,
        starts=edges[:-1],
        counts=edges[1:] - edges[:-1],
        pairs=edges[-1],
        needed=needed,
        overflow=overflow,
    )


def _sort_by_tile(tile, rank, by_depth, num_tiles: int, n: int):
    """Pairs in order of (tile, depth). Both fit one 32-bit key but for the largest of scenes."""
    rank_bits = max(1, (n - 1).bit_length())
    if rank_bits + num_tiles.bit_length() <= 32:
        key = (tile.astype(jnp.uint32) << rank_bits) | rank.astype(jnp.uint32)
        key = jax.lax.sort(key)
        rank = (key & jnp.uint32((1 << rank_bits) - 1)).astype(jnp.int32)
        return (key >> rank_bits).astype(jnp.int32), by_depth[rank]
    tile, rank = jax.lax.sort((tile, rank), num_keys=2)
    return tile, by_depth[rank]
