"""Sums of rows of gradients, one per entry of the lists, over the entries of each Gaussian."""

# Warp's types are values.
# pyright: reportOperatorIssue=false

from functools import cache

import jax.numpy as jnp
import warp as wp

from gsjax.rasterize.kernels.warps import OPTIONS, WARP, writer


@cache
def _read_ids(lanes: int):
    """The kernel that copies the ids of the entries that were read."""

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def read_ids(
        ids: wp.array[wp.int32],
        starts: wp.array[wp.int32],
        reads: wp.array[wp.int32],
        copies: wp.array[wp.uint32],
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
    write, Row = writer(length, lanes)

    @wp.kernel(module="unique", enable_backward=False, module_options=OPTIONS)
    def row_sums(
        rows: wp.array2d[wp.float32],
        order: wp.array[wp.int32],
        first: wp.array[wp.int32],
        n: int,
        sums: wp.array2d[wp.float32],
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
