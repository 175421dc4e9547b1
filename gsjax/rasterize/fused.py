"""Binning, compositing and its gradients by the kernels in `kernels/`, with the same results as in XLA alone.

The kernels are used where the platform is CUDA, Warp is installed (`pip install "gsjax[cuda]"`) and numbers
are float32. Like the loops in XLA, they read lists front to back, skip and saturate at the same alphas and
stop at the same transmittance; images agree up to rounding. Many channels are composited in several passes.
"""

from collections.abc import Callable
from functools import cache, partial
from importlib.util import find_spec

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt

from gsjax.rasterize.binning import depth_order, doubled, tile_rows, total
from gsjax.rasterize.compositing import SHAPE, Lists, Splats, chunk_length, in_columns
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import Projected
from gsjax.rasterize.tiles import in_tiles, untile

_GPU_LANES = 32  # threads per tile on a GPU; on a CPU it is 1
MOST_VALUES = 10  # per pass: with the six numbers of a shape, four times four floats


@cache
def available() -> bool:
    """Whether the kernels run on this process's default device."""
    return jax.default_backend() == "gpu" and find_spec("warp") is not None


def by_platform(in_xla: Callable, in_kernels: Callable, *arguments):
    """`in_kernels(*arguments, lanes=...)` where the kernels can run, else `in_xla(*arguments)`."""
    floats = (a.dtype for a in jax.tree.leaves(arguments) if jnp.issubdtype(a.dtype, jnp.floating))
    if not available() or jnp.float64 in floats:
        return in_xla(*arguments)
    return jax.lax.platform_dependent(*arguments, cuda=partial(in_kernels, lanes=_GPU_LANES), default=in_xla)


def composite_forward(splats: Splats, lists: Lists, plan: Plan, lanes: int):
    """The image of all tiles [high, wide, channels], transmittance [tiles, pixels], and entries read [tiles].

    Args:
        splats: the Gaussians of all views.
        lists: the lists of all tiles.
        plan: image size and limits.
        lanes: threads per tile.
    """
    from gsjax.rasterize.kernels import compositing as kernels

    tiles, channels = len(lists.counts), splats.values.shape[1]
    shapes, passes = _shapes(splats, plan), _passes(splats.values)
    form = _form(passes, channels, plan, lanes)

    def one_pass(_, values):
        values, *others = kernels.forward(form, _records(shapes, values), *lists, plan)
        return others, values

    nothing = [jnp.ones((tiles, plan.tile_pixels), jnp.float32), jnp.zeros(tiles, jnp.int32)]
    (transmittance, reads), values = jax.lax.scan(one_pass, nothing, passes)
    values = jnp.moveaxis(values, 0, 1).reshape(tiles, -1, plan.tile_pixels)
    return untile(values[:, :channels], plan), transmittance, reads


def gradients(
    splats: Splats, lists: Lists, reads: Int[Array, "tiles"], kept, cotangents, plan: Plan, lanes: int
) -> Splats:
    """Gradients with respect to all fields of the splats.

    Args:
        splats, lists, plan, lanes: as for `composite_forward`.
        reads: entries read from each list.
        kept: the image, and the transmittance of all tiles.
        cotangents: the gradients with respect to both.
    """
    (image, transmittance), (d_image, d_transmittance) = kept, cotangents
    d_values = in_tiles(d_image, plan)
    behind = _of_passes(in_tiles(image, plan)) * _of_passes(d_values)
    behind = behind.sum(axis=2).at[0].add(d_transmittance * transmittance)
    moments, d_colors = _summed(splats, lists, reads, d_values, behind, plan, lanes)
    sx, sy, sxx, sxy, syy, m = moments.T
    a, b, c = splats.conics.T
    visible = splats.opacities > 0
    return Splats(
        means2d=jnp.stack([a * sx + b * sy, b * sx + c * sy], axis=-1),
        conics=jnp.stack([-0.5 * sxx, -sxy, -0.5 * syy], axis=-1),
        opacities=jnp.where(visible, m / jnp.where(visible, splats.opacities, 1.0), 0.0),
        values=d_colors,
    )


def values_gradients(
    splats: Splats,
    lists: Lists,
    reads: Int[Array, "tiles"],
    d_image: Float[Array, "high wide channels"],
    plan: Plan,
    lanes: int,
) -> Float[Array, "n channels"]:
    """Gradients with respect to the values only. Arguments as for `gradients`."""
    return _summed(splats, lists, reads, in_tiles(d_image, plan), None, plan, lanes)[1]


def _summed(splats: Splats, lists: Lists, reads, d_values, behind, plan: Plan, lanes: int):
    """Sums over the pixels of each Gaussian: dL/dpower times dx, dy, dx^2, dx dy, dy^2 and 1 [n, 6], where
    (dx, dy) leads from its centre to the pixel, and the gradients of its values [n, channels].

    `behind` [passes, tiles, pixels] is the sum, over the values that a pass composites, of value times
    gradient, plus in the first pass the transmittance times its gradient. Without it the first result is
    empty.
    """
    from gsjax.rasterize.kernels import compositing as kernels
    from gsjax.rasterize.kernels.sums import row_sums

    n, channels = splats.values.shape
    shapes, passes = _shapes(splats, plan), _passes(splats.values)
    form = _form(passes, channels, plan, lanes)
    order, first = _by_gaussian(lists, reads, n, lanes)
    shapes_move = behind is not None
    if behind is None:
        behind = jnp.zeros((len(passes), 1, 1), jnp.float32)  # not read

    def one_pass(moments, at):
        values, d_values, behind = at
        records = _records(shapes, values)
        rows = kernels.backward(form, shapes_move, records, *lists[:2], reads, d_values, behind, plan)
        sums = row_sums(rows, order, first, lanes)
        return moments + sums[:, : moments.shape[1]], sums[:, moments.shape[1] :]

    start = jnp.zeros((n, SHAPE if shapes_move else 0), jnp.float32)
    moments, d_colors = jax.lax.scan(one_pass, start, (passes, _of_passes(d_values), behind))
    d_colors = jnp.moveaxis(d_colors, 0, 1).reshape(n, -1)[:, :channels]
    return moments, d_colors.astype(splats.values.dtype)


def _form(passes: Array, channels: int, plan: Plan, lanes: int):
    from gsjax.rasterize.kernels import compositing as kernels

    return kernels.Form(passes.shape[-1], plan.tile_size, lanes, chunk_length(channels), plan.limits)


def _values_per_pass(channels: int) -> int:
    """Values per pass, so that passes are as few as possible and of equal size."""
    return -(-channels // -(-channels // MOST_VALUES))


def _passes(values: Float[Array, "n channels"]) -> Float[Array, "passes n values"]:
    n, channels = values.shape
    each = _values_per_pass(channels)
    padded = jnp.pad(values.astype(jnp.float32), ((0, 0), (0, -channels % each)))
    return jnp.moveaxis(padded.reshape(n, -1, each), 1, 0)


def _of_passes(tiles: Float[Array, "tiles channels pixels"]) -> Float[Array, "passes tiles values pixels"]:
    num_tiles, channels, pixels = tiles.shape
    each = _values_per_pass(channels)
    padded = jnp.pad(tiles, ((0, 0), (0, -channels % each), (0, 0)))
    return jnp.moveaxis(padded.reshape(num_tiles, -1, each, pixels), 1, 0)


def _shapes(splats: Splats, plan: Plan) -> Float[Array, "n 6"]:
    logs = in_columns(splats, plan.limits).log_opacities
    return jnp.concatenate([splats.means2d, splats.conics, logs[:, None]], axis=1)


def _records(shapes: Float[Array, "n 6"], values: Float[Array, "n values"]) -> Float[Array, "numbers"]:
    """The numbers that a kernel reads for each Gaussian, one after another, padded to multiples of four."""
    both = jnp.concatenate([shapes, values], axis=1)
    return jnp.pad(both, ((0, 0), (0, -both.shape[1] % 4))).ravel()


def _by_gaussian(lists: Lists, reads: Int[Array, "tiles"], n: int, lanes: int):
    """The entries that were read, ordered by Gaussian, and where each Gaussian's entries begin [n + 1]."""
    from gsjax.rasterize.kernels.sums import read_ids

    keys = read_ids(lists.ids, lists.starts, reads, n, lanes)
    keys, order = jax.lax.sort_key_val(keys, jnp.arange(len(lists.ids), dtype=jnp.int32))
    return order, edges(keys, n)


def edges(keys: UInt[Array, "entries"], n: int) -> Int[Array, "n_plus_1"]:
    """Where 0, 1, ... n begin in sorted keys. Unrolled, because a GPU would launch a loop step by step.

    Args:
        keys: sorted keys.
        n: the largest key to look for.
    """
    return jnp.searchsorted(keys, jnp.arange(n + 1, dtype=keys.dtype), method="scan_unrolled").astype(
        jnp.int32
    )


def tile_lists(projected: Projected, mask, plan: Plan, capacity: int):
    """Lists of all tiles of all views, and the pairs, needed capacity and overflow of each view.

    Args:
        projected: fields [views, n, ...].
        mask: tiles that are drawn [views, tiles], or None for all.
        plan: image size and limits; its capacity is that of one view.
        capacity: slots of all views together.
    """
    from gsjax.rasterize.kernels import binning as kernels

    views, tiles = projected.depths.shape[0], plan.num_tiles
    by_depth = jax.vmap(lambda one: depth_order(one, plan))(projected)
    counts = kernels.count_pairs(projected, by_depth, mask, plan)
    wanted = jax.vmap(total)(counts)
    overflow = wanted > plan.capacity  # a view that overflowed draws nothing and reports it
    _, rows = jax.vmap(partial(tile_rows, plan=plan), (0, None if mask is None else 0))(projected, mask)
    needed = jnp.maximum(wanted, doubled(jax.vmap(total)(rows)))  # what XLA needs is enough everywhere
    drawn = jnp.where(overflow[:, None], 0, counts).ravel()
    starts = jnp.cumsum(drawn) - drawn
    starts = jnp.where(drawn > 0, starts, -1).astype(jnp.int32)
    keys, ids = kernels.list_pairs(projected, by_depth, mask, starts, drawn, capacity, plan)
    keys, ids = jax.lax.sort_key_val(keys, ids)  # stable: the order of depth remains
    first = edges(keys, views * tiles)
    lengths = jnp.diff(first)
    if plan.max_per_tile is not None:
        lengths = jnp.minimum(lengths, plan.max_per_tile)
    pairs = lengths.reshape(views, tiles).sum(axis=1, dtype=jnp.int32)
    return Lists(ids, first[:-1], lengths), pairs, needed, overflow
