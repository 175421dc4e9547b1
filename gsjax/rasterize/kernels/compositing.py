"""Compositing on a GPU: one warp of 32 threads per tile, written in Warp (https://github.com/NVIDIA/warp).

XLA's loops over chunks and batches launch a few small programs for every chunk, and a GPU spends its time on
launching them. Here one program reads a tile's list from front to back. Its pixels stay in registers: with
tiles of 8x8, two in each thread. Entries are read 32 at a time, one per thread, into shared memory.

Backward, a warp sums the gradients of its pixels and writes one row per entry; a second kernel sums the rows
of each Gaussian, in the order of the lists. Nothing is added atomically, so results are the same to the bit
in every run.

The same kernels run on a CPU, one thread per tile: that is how they are tested where there is no GPU.
"""

import math
from functools import cache
from typing import NamedTuple

import jax.numpy as jnp
import warp as wp

from gsjax.rasterize.compositing import SATURATION
from gsjax.rasterize.plan import Limits, Plan

WARP = 32
_WARPS = 4  # warps per block of threads
_STAGED = 32  # entries read at a time
_SHAPE = 6  # numbers per Gaussian before its values: u, v, A, B, C, log opacity

_OPTIONS = {"fast_math": True, "enable_backward": False, "max_unroll": 64}


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __any_sync(0xffffffff, flag) != 0;
#else
    return flag;
#endif
""")
def _in_any_lane(flag: bool) -> bool: ...


@cache
def _reader(fours: int):
    """`read(stage, records, ids, first, end, lane, j, part)`: four of the numbers of entry `first + j`.

    First, with `stage`, it copies entries `first`, `first + 1`, ... to the warp's part of shared memory.
    Entries from `end` on are transparent.
    """
    snippet = f"""
    const float nothing = -1e30f;  // as the logarithm of an opacity, the sixth number
#if defined(__CUDA_ARCH__)
    __shared__ float4 staged[{_WARPS}][{_STAGED}][{fours}];
    float4 (*own)[{fours}] = staged[threadIdx.x / {WARP}];
    if (stage) {{
        __syncwarp();
        const bool there = first + lane < end;
        const size_t row = there ? size_t(ids.data[first + lane]) * {fours} : 0;
        const float4* from = reinterpret_cast<const float4*>(records.data) + row;
        #pragma unroll
        for (int i = 0; i < {fours}; ++i)
            own[lane][i] = there ? from[i] : make_float4(0.0f, i == 1 ? nothing : 0.0f, 0.0f, 0.0f);
        __syncwarp();
        return wp::vec4();
    }}
    const float4 four = own[j][part];
    return wp::vec4(four.x, four.y, four.z, four.w);
#else
    if (stage) return wp::vec4();
    if (first + j >= end) return wp::vec4(0.0f, part == 1 ? nothing : 0.0f, 0.0f, 0.0f);
    const float* from = records.data + (size_t(ids.data[first + j]) * {fours} + part) * 4;
    return wp::vec4(from[0], from[1], from[2], from[3]);
#endif
"""

    @wp.func_native(snippet)
    def read(
        stage: bool,
        records: wp.array(dtype=wp.float32),
        ids: wp.array(dtype=wp.int32),
        first: int,
        end: int,
        lane: int,
        j: int,
        part: int,
    ) -> wp.vec4: ...

    return read


@cache
def _writer(length: int, lanes: int):
    """`write(sums, lane, rows, row)`: the sums of `length` numbers over 8 to 32 lanes, as a row of `rows`.

    Eight numbers are summed together: each of three exchanges halves how many a thread holds, then thread l
    has the l-th, summed over eight threads. For a warp that is 9 exchanges instead of 40. A lane that is 32
    or more takes part and writes nothing.
    """
    Sums = wp.types.vector(length=length, dtype=wp.float32)
    groups = [(start, min(8, length - start)) for start in range(0, length, 8)]
    pieces = []
    for start, size in groups:
        width = 1 << (size - 1).bit_length()
        values = ", ".join(f"sums[{start + i}]" if i < size else "0.0f" for i in range(width))
        pieces.append(f"""
    {{
        float v[{width}] = {{{values}}};
        #pragma unroll
        for (int half = {width // 2}; half >= 1; half /= 2) {{
            const bool upper = lane & half;
            #pragma unroll
            for (int i = 0; i < half; ++i) {{
                const float other = __shfl_xor_sync(0xffffffff, upper ? v[i] : v[i + half], half);
                v[i] = (upper ? v[i + half] : v[i]) + other;
            }}
        }}
        #pragma unroll
        for (int mask = {width}; mask < {lanes}; mask *= 2) v[0] += __shfl_xor_sync(0xffffffff, v[0], mask);
        if (lane < {size}) to[{start} + lane] = v[0];
    }}""")
    snippet = f"""
    float* to = rows.data + size_t(row) * {length};
#if defined(__CUDA_ARCH__){"".join(pieces)}
#else
    for (int i = 0; i < {length}; ++i) to[i] = sums[i];
#endif
"""

    @wp.func_native(snippet)
    def write(sums: Sums, lane: int, rows: wp.array2d(dtype=wp.float32), row: int): ...

    return write, Sums


class Form(NamedTuple):
    """What a kernel is compiled for."""

    values: int  # channels
    tile_size: int
    lanes: int  # threads per tile: 32 on a GPU, 1 on a CPU
    check: int  # entries after which a tile whose pixels are all opaque ends
    limits: Limits

    @property
    def fours(self) -> int:
        return -(-(_SHAPE + self.values) // 4)

    @property
    def block(self) -> int | None:
        """Threads per block."""
        return None if self.lanes == 1 else WARP * _WARPS

    @property
    def unroll(self) -> int:
        """Entries whose alphas are computed together."""
        return max(1, min(4, 16 // self.per_lane)) if self.lanes > 1 else 1

    @property
    def per_lane(self) -> int:
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
    read, (center, place, alpha) = _reader(form.fours), _shared(form)
    fours, check, staged = form.fours, form.check, _STAGED
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Alphas = wp.types.vector(length=unroll * per_lane, dtype=wp.float32)
    Sums = wp.types.vector(length=per_lane * values_per_pixel, dtype=wp.float32)
    Record = wp.types.vector(length=4 * fours, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def forward(
        records: wp.array(dtype=wp.float32),
        ids: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        tiles_x: int,
        num_tiles: int,
        values: wp.array3d(dtype=wp.float32),
        transmittance: wp.array2d(dtype=wp.float32),
        reads: wp.array(dtype=wp.int32),
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
                        sums[values_per_pixel * k + c] += weight * record[6 + c]
                    light[k] = wp.where(live, after, -wp.abs(light[k]))
            entry += unroll
            alive = entry < count
            if alive and entry % check == 0:
                brightest = float(-1.0)
                for k in range(per_lane):
                    brightest = wp.max(brightest, light[k])
                alive = _in_any_lane(brightest > 0.0)
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
    read, (center, place, alpha) = _reader(form.fours), _shared(form)
    fours, staged = form.fours, _STAGED
    first_value = _SHAPE if shapes_move else 0
    write, Row = _writer(first_value + values_per_pixel, lanes)
    Pixels = wp.types.vector(length=per_lane, dtype=wp.float32)
    Alphas = wp.types.vector(length=unroll * per_lane, dtype=wp.float32)
    Values = wp.types.vector(length=per_lane * values_per_pixel, dtype=wp.float32)
    Record = wp.types.vector(length=4 * fours, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def backward(
        records: wp.array(dtype=wp.float32),
        ids: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        reads: wp.array(dtype=wp.int32),
        d_values: wp.array3d(dtype=wp.float32),
        total: wp.array2d(dtype=wp.float32),
        tiles_x: int,
        num_tiles: int,
        rows: wp.array2d(dtype=wp.float32),
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
                if _in_any_lane(painted > 0.0):  # rows start as zeros
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
                                toward += record[6 + c] * d_image[values_per_pixel * k + c]
                        if wp.static(shapes_move):
                            one = alphas[per_lane * j + k]
                            passed = weights[k] * toward
                            behind[k] -= passed
                            moved = weights[k] > 0.0 and one < saturated_alpha
                            d_power = wp.where(moved, passed - behind[k] * one / wp.max(1.0 - one, 1e-6), 0.0)
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


@cache
def _read_ids(lanes: int):
    """The kernel that copies the ids of the entries that were read."""

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def read_ids(
        ids: wp.array(dtype=wp.int32),
        starts: wp.array(dtype=wp.int32),
        reads: wp.array(dtype=wp.int32),
        copies: wp.array(dtype=wp.uint32),
    ):
        thread = wp.tid()
        tile = thread // lanes
        i = thread % lanes
        while i < reads[tile]:
            slot = starts[tile] + i
            copies[slot] = wp.uint32(ids[slot])
            i += lanes

    return read_ids


@cache
def _row_sums(length: int, lanes: int):
    """The kernel that sums rows[order[i]] for i from first[g] to first[g + 1], for each g."""
    write, Row = _writer(length, lanes)

    @wp.kernel(module="unique", enable_backward=False, module_options=_OPTIONS)
    def row_sums(
        rows: wp.array2d(dtype=wp.float32),
        order: wp.array(dtype=wp.int32),
        first: wp.array(dtype=wp.int32),
        n: int,
        sums: wp.array2d(dtype=wp.float32),
    ):
        thread = wp.tid()
        g, lane = thread // lanes, thread % lanes
        row = Row()
        if g < n:
            i = first[g] + lane
            end = first[g + 1] + 0
            while i < end:
                at = order[i] + 0
                for c in range(length):
                    row[c] += rows[at, c]
                i += lanes
        write(row, wp.where(g < n, lane, lane + 32), sums, wp.min(g, n - 1))

    return row_sums


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
    rows = jnp.zeros((len(ids), form.values + (_SHAPE if shapes_move else 0)), jnp.float32)
    arrays = (records, ids, starts, reads, d_values, behind, plan.tiles_x, plan.num_tiles, rows)
    return wp.jax_kernel(kernel, **options)(*arrays, launch_dims=len(starts) * form.lanes)[0]


def read_ids(ids, starts, reads, otherwise: int, lanes: int):
    """The Gaussian [entries] of each entry that was read; `otherwise` for the others.

    Args:
        ids, starts: the lists of all tiles.
        reads: entries read from each list.
        otherwise: an id that no Gaussian has.
        lanes: threads per tile.
    """
    call = wp.jax_kernel(_read_ids(lanes), vmap_method="sequential", in_out_argnames=["copies"])
    copies = jnp.full(len(ids), otherwise, jnp.uint32)
    return call(ids, starts, reads, copies, launch_dims=len(starts) * lanes)[0]


def row_sums(rows, order, first, lanes: int):
    """The sum [n, length] of rows[order[i]] for i from first[g] to first[g + 1] - 1, for every g.

    Args:
        rows: [entries, length].
        order, first: as above; `first` has n + 1 entries.
        lanes: threads per tile. A sum has a quarter of them: most Gaussians have few entries.
    """
    lanes, n = max(1, lanes // 4), len(first) - 1
    threads = n if lanes == 1 else -(-n * lanes // WARP) * WARP  # whole warps
    call = wp.jax_kernel(_row_sums(rows.shape[1], lanes), vmap_method="sequential")
    return call(rows, order, first, n, launch_dims=threads, output_dims=(n, rows.shape[1]))[0]
