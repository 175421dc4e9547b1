"""Binning on a GPU: one thread per Gaussian counts the tiles it touches, then writes one key for each.

In XLA this takes gathers, scatters and running sums over all rows of tiles and over all pairs. See
`gsjax.rasterize.binning` for the geometry, which is the same here.
"""

# Warp's types are values.
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import warp as wp

from gsjax.rasterize.plan import Plan
from gsjax.rasterize.projection import Projected

_TINY, _EPS = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).eps)
# Without fused operations both kernels compute the same tiles, though they are compiled apart.
_OPTIONS = {"enable_backward": False, "fuse_fp": False}


@wp.struct
class _Ellipse:
    """Where a Gaussian reaches alpha_min: see `_columns_in_row`."""

    u: wp.float32
    v: wp.float32
    half_x: wp.float32
    half_y: wp.float32
    furthest: wp.float32
    slope: wp.float32
    width: wp.float32
    first_row: wp.int32
    end_row: wp.int32


class _Form(NamedTuple):
    """What the kernels are compiled for."""

    tile_size: int
    tiles_x: int
    tiles_y: int
    alpha_min: float
    masked: bool


@cache
def _kernels(form: _Form, key_type: str):
    """The kernel that counts the tiles of every Gaussian, and the one that lists them."""
    size, edge = float(form.tile_size), float(form.tile_size - 1)
    tiles_x, num_tiles, masked = form.tiles_x, form.tiles_x * form.tiles_y, form.masked
    width, height, alpha_min = float(tiles_x * form.tile_size), float(form.tiles_y), form.alpha_min
    Key = getattr(wp, key_type)

    @wp.func
    def ellipse(
        g: int,
        means2d: wp.array2d[wp.float32],
        extents: wp.array2d[wp.float32],
        conics: wp.array2d[wp.float32],
        opacities: wp.array[wp.float32],
    ) -> _Ellipse:
        e = _Ellipse()
        e.u = means2d[g, 0]
        e.v = means2d[g, 1]
        e.half_x = extents[g, 0]
        e.half_y = extents[g, 1]
        a, b, c = wp.max(conics[g, 0], _TINY), conics[g, 1] + 0.0, wp.max(conics[g, 2], _TINY)
        level = 2.0 * wp.log(wp.max(opacities[g] / alpha_min, 1.0)) * 1.0002 + 1e-3
        e.furthest = -b / c * e.half_x
        e.slope = -b / a
        e.width = wp.sqrt(level / a)
        e.first_row = int(wp.clamp(wp.floor((e.v - e.half_y) / size), 0.0, height))
        e.end_row = int(wp.clamp(wp.floor((e.v + e.half_y) / size) + 1.0, 0.0, height))
        return e

    @wp.func
    def reach(dy: float, e: _Ellipse) -> float:
        share = dy / e.half_y
        return e.width * wp.sqrt(wp.max(1.0 - share * share, 0.0))

    @wp.func
    def columns(row: int, e: _Ellipse) -> wp.vec2i:
        top = float(row) * size + 0.5 - e.v
        low, high = wp.max(top, -e.half_y), wp.min(top + edge, e.half_y)
        at_right, at_left = wp.clamp(e.furthest, low, high), wp.clamp(-e.furthest, low, high)
        slack = 1e-3 + 16.0 * _EPS * (wp.abs(e.u) + e.half_x)
        right = e.u + wp.min(e.slope * at_right + reach(at_right, e), e.half_x) + slack
        left = e.u + wp.max(e.slope * at_left - reach(at_left, e), -e.half_x) - slack
        first = wp.clamp(wp.ceil(left - 0.5), 0.0, width)
        last = wp.clamp(wp.floor(right - 0.5), -1.0, width - 1.0)
        start = int(wp.floor(first / size))
        end = int(wp.floor(last / size)) + 1
        if low > high or first > last:
            end = start
        return wp.vec2i(start, end)

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def count(
        means2d: wp.array2d[wp.float32],
        extents: wp.array2d[wp.float32],
        conics: wp.array2d[wp.float32],
        opacities: wp.array[wp.float32],
        visible: wp.array[wp.bool],
        by_depth: wp.array[wp.int32],
        mask: wp.array[wp.bool],
        n: int,
        counts: wp.array[wp.int32],
    ):
        thread = wp.tid()
        view = thread // n
        g = view * n + by_depth[thread]
        found = int(0)
        if visible[g]:
            e = ellipse(g, means2d, extents, conics, opacities)
            for row in range(e.first_row, e.end_row):
                span = columns(row, e)
                if wp.static(not masked):
                    found += wp.max(span[1] - span[0], 0)
                else:
                    for column in range(span[0], span[1]):
                        if mask[view * num_tiles + row * tiles_x + column]:
                            found += 1
        counts[thread] = found

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def list_tiles(
        means2d: wp.array2d[wp.float32],
        extents: wp.array2d[wp.float32],
        conics: wp.array2d[wp.float32],
        opacities: wp.array[wp.float32],
        visible: wp.array[wp.bool],
        by_depth: wp.array[wp.int32],
        mask: wp.array[wp.bool],
        starts: wp.array[wp.int32],
        counts: wp.array[wp.int32],
        n: int,
        keys: wp.array[Key],
        ids: wp.array[wp.int32],
    ):
        thread = wp.tid()
        view = thread // n
        g = view * n + by_depth[thread]
        slot = starts[thread] + 0
        end = slot + counts[thread]
        if visible[g] and slot >= 0:
            e = ellipse(g, means2d, extents, conics, opacities)
            for row in range(e.first_row, e.end_row):
                span = columns(row, e)
                for column in range(span[0], span[1]):
                    tile = view * num_tiles + row * tiles_x + column
                    wanted = bool(True)
                    if wp.static(masked):
                        wanted = mask[tile]
                    if wanted and slot < end:
                        keys[slot] = Key(tile)
                        ids[slot] = g
                        slot += 1

    return count, list_tiles


def _form(plan: Plan, mask) -> _Form:
    return _Form(plan.tile_size, plan.tiles_x, plan.tiles_y, plan.alpha_min, mask is not None)


def _inputs(projected: Projected, by_depth, mask):
    """Arrays of all views, one after the other."""
    views, n = by_depth.shape
    fields = (projected.means2d, projected.extents, projected.conics, projected.opacities, projected.visible)
    fields = [a.reshape(views * n, *a.shape[2:]) for a in fields]
    return *fields, by_depth.ravel(), jnp.ones(1, bool) if mask is None else mask.ravel()


def count_pairs(projected: Projected, by_depth, mask, plan: Plan):
    """The number of tiles that each Gaussian touches [views, n], in order of depth.

    Args:
        projected: fields [views, n, ...].
        by_depth: Gaussians of each view, front to back [views, n].
        mask: tiles that are drawn [views, tiles], or None for all.
        plan: image size and limits.
    """
    kernel, _ = _kernels(_form(plan, mask), "uint32")
    views, n = by_depth.shape
    call = wp.jax_kernel(kernel, vmap_method="sequential")
    counts = call(*_inputs(projected, by_depth, mask), n, launch_dims=views * n, output_dims=views * n)
    return counts[0].reshape(views, n)


def list_pairs(projected: Projected, by_depth, mask, starts, counts, capacity: int, plan: Plan):
    """Unsorted keys, view * tiles + tile, and ids, view * n + Gaussian, of all pairs, front to back.

    Args:
        projected, by_depth, mask, plan: as for `count_pairs`.
        starts: the slot of each Gaussian's first pair [views * n]; -1 writes none.
        counts: the number of its pairs [views * n].
        capacity: number of slots. Unused ones get the largest key, views * tiles, and the id 0.
    """
    views, n = by_depth.shape
    unused = views * plan.num_tiles
    narrow = unused < 2**16  # sorting takes half as long
    keys = jnp.full(capacity, unused, jnp.uint16 if narrow else jnp.uint32)
    _, kernel = _kernels(_form(plan, mask), str(keys.dtype))
    call = wp.jax_kernel(kernel, num_outputs=2, vmap_method="sequential", in_out_argnames=["keys", "ids"])
    inputs = (*_inputs(projected, by_depth, mask), starts, counts, n, keys, jnp.zeros(capacity, jnp.int32))
    return call(*inputs, launch_dims=views * n)
