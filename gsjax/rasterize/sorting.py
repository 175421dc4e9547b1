"""Sorts and running sums of 32-bit numbers: numpy's where XLA runs on the CPU, XLA's own elsewhere.

XLA:CPU sorts with scalar comparisons, while numpy and scipy sort by counting, and sum faster. On two cores of
an AMD EPYC the 830,000 pairs of the garden (`benchmarks`) take 10 ms instead of 60, and a running sum of a
million takes 0.3 ms instead of 2. Binning consists mostly of these. Both implementations agree bit for bit.
Where the call to numpy (`host.py`) is not possible, XLA's own is used on the CPU too.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt32
from scipy.sparse import csr_array

from gsjax.rasterize.host import call, register


def _argsort_into(keys: np.ndarray, out: np.ndarray) -> None:
    # By the low half, then by the high one: numpy sorts 16 bits stably by counting.
    order = np.argsort(keys.astype(np.uint16), axis=-1, kind="stable")
    high = (keys >> 16).astype(np.uint16)
    if high.any():
        by_high = np.argsort(np.take_along_axis(high, order, axis=-1), axis=-1, kind="stable")
        order = np.take_along_axis(order, by_high, axis=-1)
    np.copyto(out, order, casting="same_kind")


def _sum_into(counts: np.ndarray, out: np.ndarray) -> None:
    np.cumsum(counts, axis=-1, dtype=out.dtype, out=out)


def _repeat_into(values: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
    for row, begins, filled in _rows(values, starts, out):
        steps = np.diff(row, prepend=row.dtype.type(0))
        inside = np.searchsorted(begins, len(filled))  # starts are non-decreasing
        filled[:] = 0
        np.add.at(filled, begins[:inside], steps[:inside])
        np.cumsum(filled, dtype=filled.dtype, out=filled)


def _lists_into(items: np.ndarray, firsts: np.ndarray, counts: np.ndarray, out, edges) -> None:
    # In a sparse matrix of entries by lists, the input is its compressed rows and the output its compressed
    # columns, and scipy converts one to the other by counting.
    for item, first, count, filled, edge in _rows(items, firsts, counts, out, edges):
        ends = np.cumsum(count, dtype=np.int32)
        pointers = np.append(np.int32(0), ends)
        columns, data = np.repeat(first - pointers[:-1], count), np.repeat(item, count)
        columns += np.arange(len(columns), dtype=np.int32)
        by_list = csr_array((data, columns, pointers), shape=(len(item), len(edge) - 1)).tocsc()
        filled[: by_list.nnz], filled[by_list.nnz :] = by_list.data, 0
        edge[:] = by_list.indptr


def _rows(*arrays: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows along the last axis of each array, in parallel."""
    return zip(*(a.reshape(math.prod(a.shape[:-1]), a.shape[-1]) for a in arrays), strict=True)


_WORK = {
    "gsjax_argsort": _argsort_into,
    "gsjax_running_sum": _sum_into,
    "gsjax_repeat": _repeat_into,
    "gsjax_lists": _lists_into,
}
_AVAILABLE = all([register(name, work) for name, work in _WORK.items()])
CUSTOM_CALLS = tuple(_WORK)
"""Names of the custom calls, which the export of programs needs."""


def _either(name: str, where: str, on_device: Callable, result, *arguments: Array) -> Any:
    """Numpy's result if `where` is "host" and the platform is the CPU, else `on_device(*arguments)`."""
    if where == "device" or not _AVAILABLE:
        return on_device(*arguments)
    return jax.lax.platform_dependent(
        *arguments, cpu=lambda *arrays: call(name, result, *arrays), default=on_device
    )


def argsort_keys(keys: UInt32[Array, "n"], where: str = "host") -> Int[Array, "n"]:
    """The stable order of the keys. `where` is a plan's `sort`: "host", or "device" for XLA's own sort."""

    def on_device(keys):
        return jnp.argsort(keys, stable=True).astype(jnp.int32)

    return _either("gsjax_argsort", where, on_device, jax.ShapeDtypeStruct(keys.shape, jnp.int32), keys)


def running_sum(counts: Int[Array, "n"], where: str = "host") -> Int[Array, "n"]:
    """Sums of the first 1, 2, ... n counts, modulo 2^32. `where` as in `argsort_keys`."""
    result = jax.ShapeDtypeStruct(counts.shape, jnp.int32)
    return _either("gsjax_running_sum", where, jnp.cumsum, result, counts)


def repeat(
    values: Int[Array, "n"] | UInt32[Array, "n"], starts: Int[Array, "n"], length: int, where: str = "host"
) -> Array:
    """An array [length] of `values[i]` from `starts[i]` to the next start. `where` as in `argsort_keys`.

    Args:
        values: any values; their differences may wrap.
        starts: non-decreasing. If several values start at the same index, the last one counts.
        length: length of the result; values that start beyond it are left out.
    """

    def on_device(values, starts):
        steps = jnp.diff(values, prepend=jnp.zeros(1, values.dtype))
        summed = jnp.zeros(length, values.dtype).at[starts].add(steps, mode="drop")
        return jnp.cumsum(summed, dtype=values.dtype)

    return _either(
        "gsjax_repeat", where, on_device, jax.ShapeDtypeStruct((length,), values.dtype), values, starts
    )


def lists(
    items: Int[Array, "n"],
    firsts: Int[Array, "n"],
    counts: Int[Array, "n"],
    num_items: int,
    num_lists: int,
    length: int,
    where: str = "host",
) -> tuple[Int[Array, "length"], Int[Array, "edges"]]:
    """Lists of items, from entries that each put an item into a range of consecutive lists.

    Args:
        items: the item of each entry, non-decreasing, 0 to `num_items` - 1.
        firsts: the first list of each entry.
        counts: number of lists of each, 0 or more.
        num_items: number of different items.
        num_lists: number of lists.
        length: length of the result; the counts add up to no more.
        where: as in `argsort_keys`.

    Returns:
        The lists one after another, each in ascending order, padded with arbitrary items; and where each list
        starts, followed by where the last one ends.
    """

    def on_device(items, firsts, counts):
        ends = jnp.cumsum(counts)
        slot = jnp.arange(length, dtype=jnp.int32)
        listed, shift = (repeat(a, ends - counts, length, "device") for a in (items, firsts - ends + counts))
        which = jnp.where(slot < counts.sum(), shift + slot, num_lists)
        bits = max(1, (num_items - 1).bit_length())
        if bits + num_lists.bit_length() > 32:
            order = jnp.argsort(which, stable=True)
            which, listed = which[order], listed[order]
        else:  # one key holds both, which is faster
            keys = jnp.sort((which.astype(jnp.uint32) << bits) | listed.astype(jnp.uint32))
            which, listed = (keys >> bits).astype(jnp.int32), (keys & ((1 << bits) - 1)).astype(jnp.int32)
        edges = jnp.searchsorted(which, jnp.arange(num_lists + 1, dtype=jnp.int32))
        return [listed, edges.astype(jnp.int32)]

    result = [jax.ShapeDtypeStruct((size,), jnp.int32) for size in (length, num_lists + 1)]
    return tuple(_either("gsjax_lists", where, on_device, result, items, firsts, counts))
