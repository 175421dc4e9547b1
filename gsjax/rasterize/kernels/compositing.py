"""Compositing on a GPU: one warp of 32 threads per tile, written in Warp (https://github.com/NVIDIA/warp).

XLA's loops over chunks and batches launch a few small programs for every chunk, and a GPU spends its time on
launching them. Here one program reads a tile's list from front to back. Its pixels are in registers: with
tiles of 8x8, two in each thread.

Backward, a warp sums the gradients of its pixels and writes one row per entry; `sums.py` adds the rows of
each Gaussian in a fixed order. Nothing is added atomically, so results are the same to the bit in every run.

The same kernels run on a CPU, one thread per tile: that is how they are tested where there is no GPU.
"""

# Warp's types are values.
# pyright: reportOperatorIssue=false

import math
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import warp as wp

from gsjax.rasterize.compositing import SATURATION, SHAPE
from gsjax.rasterize.gradients import SMALL
from gsjax.rasterize.kernels.warps import OPTIONS, STAGED, WARP, WARPS, in_any_lane, reader, writer
from gsjax.rasterize.plan import Limits, Plan


class Form(NamedTuple):
    """What a kernel is compiled for."""

    values: int  # channels
    tile_size: int
    lanes: int  # threads per tile: 32 on a GPU, 1 on a CPU
    check: int  # entries after which a tile whose pixels are all opaque ends
    limits: Limits

    @property
    def fours(self) -> int:
        """Groups of four numbers per Gaussian."""
        return -(-(SHAPE + self.values) // 4)

    @property
    def block(self) -> int | None:
        """Threads per block."""
        return None if self.lanes == 1 else WARP * WARPS

    @property
    def unroll(self) -> int:
        """Entries whose alphas are computed together."""
        return max(1, min(4, 16 // self.per_lane)) if self.lanes > 1 else 1

    @property
    def per_lane(self) -> int:
        """Pixels per thread."""
        return -(-self.tile_size * self.tile_size // self.lanes)


@cache
def _shared(form: Form):
    """`(center, place, alpha)`: functions that both passes use."""
    size, limits = form.tile_size, form.limits
    log_min, log_max, alpha_max = math.log(limits.alpha_min), math.log(limits.alpha_max), limits.alpha_max

    @wp.func
    def center(tile: int, tiles_x: int, num_tiles: int) -> wp.vec2:
        within = tile % num_tiles
        corner = wp.vec2(float(within % tiles_x), float(within // tiles_x))
        return corner * float(size) + wp.vec2(0.5 * float(size), 0.5 * float(size))

    @wp.func
    def place(pixel: int) -> wp.vec2:
        """A pixel's centre relative to the tile's."""
        return wp.vec2(
            float(pixel % size) + 0.5 - 0.5 * float(size), float(pixel // size) + 0.5 - 0.5 * float(size)
        )

    @wp.func
    def alpha(dx: float, dy: float, a: float, b: float, c: float, log_opacity: float) -> float:
        power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
        log_alpha = log_opacity + wp.min(power, 0.0)
        clamped = wp.where(log_alpha >= log_max - SATURATION, alpha_max, wp.exp(log_alpha))
        return wp.where(log_alpha >= log_min, clamped, 0.0)

    return center, place, alpha


@cache
def _forward(form: Form):
    """The kernel that composites every tile."""
    values_per_pixel, lanes, per_lane, unroll = form.values, form.lanes, form.per_lane, form.unroll
    num_pixels, least_light = form.tile_size**2, form.limits.min_transmittance
    read, (center, place, alpha) = reader(form.fours), _shared(form)
    fours, check, staged = form.fours, form.check, STAGED
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Alphas = wp.types.vector(length=unroll * per_lane, dtype=wp.float32)
    Sums = wp.types.vector(length=per_lane * values_per_pixel, dtype=wp.float32)
    Record = wp.types.vector(length=4 * fours, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def forward(
        records: wp.array[wp.float32],
        ids: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        counts: wp.array[wp.int32],
        tiles_x: int,
        num_tiles: int,
        values: wp.array3d[wp.float32],
        transmittance: wp.array2d[wp.float32],
        reads: wp.array[wp.int32],
    ):
        thread = wp.tid()
        tile, lane = thread // lanes, thread % lanes
        middle = center(tile, tiles_x, num_tiles)
        x, y, light = Pixels(), Pixels(), Pixels()
        sums, record, alphas = Sums(), Record(), Alphas()
        for k in range(per_lane):
            at = place(lane + lanes * k)
            x[k] = at[0]
            y[k] = at[1]
            light[k] = wp.where(lane + lanes * k < num_pixels, 1.0, -1.0)
        start, count = starts[tile] + 0, counts[tile] + 0  # + 0: Warp reads an array where its value is used
        entry = int(0)
        alive = count > 0
        while alive:
            first = entry - entry % staged
            if entry == first:
                read(True, records, ids, start + first, start + count, lane, 0, 0)
            # The alphas of several entries do not depend on each other, so that the GPU need not wait.
            for j in range(unroll):
                for q in range(2):
                    four = read(False, records, ids, start + first, start + count, lane, entry - first + j, q)
                    for i in range(4):
                        record[4 * q + i] = four[i]
                u, v = record[0] - middle[0], record[1] - middle[1]
                for k in range(per_lane):
                    alphas[per_lane * j + k] = alpha(
                        x[k] - u, y[k] - v, record[2], record[3], record[4], record[5]
                    )
            for j in range(unroll):
                for q in range(1, fours):
                    four = read(False, records, ids, start + first, start + count, lane, entry - first + j, q)
                    for i in range(4):
                        record[4 * q + i] = four[i]
                for k in range(per_lane):
                    after = light[k] * (1.0 - alphas[per_lane * j + k])
                    live = after > least_light
                    weight = wp.where(live, alphas[per_lane * j + k] * light[k], 0.0)
                    for c in range(values_per_pixel):
                        sums[values_per_pixel * k + c] += weight * record[SHAPE + c]
                    light[k] = wp.where(live, after, -wp.abs(light[k]))
            entry += unroll
            alive = entry < count
            if alive and entry % check == 0:
                brightest = float(-1.0)
                for k in range(per_lane):
                    brightest = wp.max(brightest, light[k])
                alive = in_any_lane(brightest > 0.0)
        for k in range(per_lane):
            pixel = lane + lanes * k
            if pixel < num_pixels:
                transmittance[tile, pixel] = wp.abs(light[k])
                for c in range(values_per_pixel):
                    values[tile, c, pixel] = sums[values_per_pixel * k + c]
        if lane == 0:
            reads[tile] = wp.min(entry, count)

    return forward


@cache
def _backward(form: Form, shapes_move: bool):
    """The kernel that writes one row of gradients per entry: of the shape if it moves, then of the values.

    Of the shape these are the sums over pixels of dL/dpower times dx, dy, dx^2, dx dy, dy^2 and 1, where
    (dx, dy) leads from the Gaussian's centre to the pixel.
    """
    values_per_pixel, lanes, per_lane, unroll = form.values, form.lanes, form.per_lane, form.unroll
    num_pixels, least_light = form.tile_size**2, form.limits.min_transmittance
    saturated_alpha = form.limits.alpha_max * (1 - 0.5 * SATURATION)
    read, (center, place, alpha) = reader(form.fours), _shared(form)
    fours, staged = form.fours, STAGED
    first_value = SHAPE if shapes_move else 0
    write, Row = writer(first_value + values_per_pixel, lanes)
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Alphas = wp.types.vector(length=unroll * per_lane, dtype=wp.float32)
    Values = wp.types.vector(length=per_lane * values_per_pixel, dtype=wp.float32)
    Record = wp.types.vector(length=4 * fours, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def backward(
        records: wp.array[wp.float32],
        ids: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        reads: wp.array[wp.int32],
        d_values: wp.array3d[wp.float32],
        total: wp.array2d[wp.float32],
        tiles_x: int,
        num_tiles: int,
        rows: wp.array2d[wp.float32],
    ):
        thread = wp.tid()
        tile, lane = thread // lanes, thread % lanes
        middle = center(tile, tiles_x, num_tiles)
        x, y, light, behind, weights = Pixels(), Pixels(), Pixels(), Pixels(), Pixels()
        d_image, record, alphas = Values(), Record(), Alphas()
        for k in range(per_lane):
            pixel = lane + lanes * k
            at = place(pixel)
            x[k] = at[0]
            y[k] = at[1]
            light[k] = wp.where(pixel < num_pixels, 1.0, -1.0)
            if pixel < num_pixels:
                if wp.static(shapes_move):
                    behind[k] = total[tile, pixel]
                for c in range(values_per_pixel):
                    d_image[values_per_pixel * k + c] = d_values[tile, c, pixel]
        start, count = starts[tile] + 0, reads[tile] + 0
        entry = int(0)
        while entry < count:
            first = entry - entry % staged
            if entry == first:
                read(True, records, ids, start + first, start + count, lane, 0, 0)
            for j in range(unroll):
                for q in range(2):
                    four = read(False, records, ids, start + first, start + count, lane, entry - first + j, q)
                    for i in range(4):
                        record[4 * q + i] = four[i]
                u, v = record[0] - middle[0], record[1] - middle[1]
                for k in range(per_lane):
                    alphas[per_lane * j + k] = alpha(
                        x[k] - u, y[k] - v, record[2], record[3], record[4], record[5]
                    )
            for j in range(unroll):
                painted = float(0.0)
                for k in range(per_lane):
                    after = light[k] * (1.0 - alphas[per_lane * j + k])
                    live = after > least_light
                    weights[k] = wp.where(live, alphas[per_lane * j + k] * light[k], 0.0)
                    painted = wp.max(painted, weights[k])
                    light[k] = wp.where(live, after, -wp.abs(light[k]))
                if in_any_lane(painted > 0.0):  # rows start as zeros
                    for q in range(fours):
                        four = read(
                            False, records, ids, start + first, start + count, lane, entry - first + j, q
                        )
                        for i in range(4):
                            record[4 * q + i] = four[i]
                    u, v = record[0] - middle[0], record[1] - middle[1]
                    row = Row()
                    for k in range(per_lane):
                        toward = float(0.0)
                        for c in range(values_per_pixel):
                            row[first_value + c] += weights[k] * d_image[values_per_pixel * k + c]
                            if wp.static(shapes_move):
                                toward += record[SHAPE + c] * d_image[values_per_pixel * k + c]
                        if wp.static(shapes_move):
                            one = alphas[per_lane * j + k]
                            passed = weights[k] * toward
                            behind[k] -= passed
                            moved = weights[k] > 0.0 and one < saturated_alpha
                            d_power = wp.where(
                                moved, passed - behind[k] * one / wp.max(1.0 - one, SMALL), 0.0
                            )
                            dx, dy = x[k] - u, y[k] - v
                            row[0] += d_power * dx
                            row[1] += d_power * dy
                            row[2] += d_power * dx * dx
                            row[3] += d_power * dx * dy
                            row[4] += d_power * dy * dy
                            row[5] += d_power
                    write(row, lane, rows, start + entry + j)
            entry += unroll

    return backward


def forward(form: Form, records, ids, starts, counts, plan: Plan):
    """Values [tiles, values, pixels], transmittance [tiles, pixels] and reads [tiles] of all tiles.

    Args:
        form: what the kernel is compiled for.
        records: the shapes and values of all Gaussians, each padded to a multiple of four numbers.
        ids, starts, counts: the lists of all tiles.
        plan: image size.
    """
    tiles, pixels = len(counts), form.tile_size**2
    dims = {"values": (tiles, form.values, pixels), "transmittance": (tiles, pixels), "reads": tiles}
    call = wp.jax_kernel(_forward(form), num_outputs=3, vmap_method="sequential", block_dim=form.block)
    size = {"launch_dims": tiles * form.lanes, "output_dims": dims}
    return call(records, ids, starts, counts, plan.tiles_x, plan.num_tiles, **size)


def backward(form: Form, shapes_move: bool, records, ids, starts, reads, d_values, behind, plan: Plan):
    """One row of gradients per entry of the lists; zeros where nothing was drawn.

    Args:
        form, records, ids, starts, plan: as for `forward`.
        shapes_move: whether a row begins with the six sums of the shape.
        reads: entries read from each list.
        d_values: gradients with respect to the values [tiles, values, pixels].
        behind: per pixel [tiles, pixels], the sum of values times d_values, and of transmittance times its
            gradient; read if `shapes_move`.
    """
    kernel = _backward(form, shapes_move)
    options = {"vmap_method": "sequential", "block_dim": form.block, "in_out_argnames": ["rows"]}
    rows = jnp.zeros((len(ids), form.values + (SHAPE if shapes_move else 0)), jnp.float32)
    arrays = (records, ids, starts, reads, d_values, behind, plan.tiles_x, plan.num_tiles, rows)
    return wp.jax_kernel(kernel, **options)(*arrays, launch_dims=len(starts) * form.lanes)[0]
