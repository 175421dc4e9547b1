"""Sorts and running sums of 32-bit numbers: numpy's where XLA runs on the CPU, XLA's own elsewhere.

XLA:CPU sorts with scalar comparisons: half a million keys take it 17 ms, numpy 1.1 ms; a running sum of a
million takes it 2 ms, numpy 0.3. Binning consists mostly of these. Both implementations agree bit for bit.
Where the call to numpy (`host.py`) is not possible, XLA's own is used on the CPU too.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, UInt32

from gsjax.rasterize.host import call, register


def _sort_into(keys: np.ndarray, out: np.ndarray) -> None:
    np.copyto(out, keys)
    out.sort(axis=-1)


def _argsort_into(keys: np.ndarray, out: np.ndarray) -> None:
    # The position in the low bits makes every key unique, hence the order stable, and 64 bits sort fast.
    paired = keys.astype(np.uint64)
    paired <<= np.uint64(32)
    paired |= np.arange(keys.shape[-1], dtype=np.uint64)
    paired.sort(axis=-1)
    np.copyto(out, paired.astype(np.uint32).view(np.int32))


def _sum_into(counts: np.ndarray, out: np.ndarray) -> None:
    np.cumsum(counts, axis=-1, dtype=out.dtype, out=out)


def _repeat_into(values: np.ndarray, starts: np.ndarray, out: np.ndarray) -> None:
    rows = (a.reshape(math.prod(a.shape[:-1]), a.shape[-1]) for a in (values, starts, out))
    for row, begins, filled in zip(*rows, strict=True):
        steps = np.diff(row, prepend=row.dtype.type(0))
        inside = np.searchsorted(begins, len(filled))  # starts are non-decreasing
        filled[:] = 0
        np.add.at(filled, begins[:inside], steps[:inside])
        np.cumsum(filled, dtype=filled.dtype, out=filled)


_WORK = {
    "gsjax_sort": _sort_into,
    "gsjax_argsort": _argsort_into,
    "gsjax_running_sum": _sum_into,
    "gsjax_repeat": _repeat_into,
}
_AVAILABLE = all([register(name, work) for name, work in _WORK.items()])
CUSTOM_CALLS = tuple(_WORK)
"""Names of the custom calls, for those who export programs."""


def _either(name: str, where: str, on_device: Callable, result, *arguments: Array) -> Array:
    """Numpy's result if `where` is "host" and the platform is the CPU, else `on_device(*arguments)`."""
    if where == "device" or not _AVAILABLE:
        return on_device(*arguments)
    return jax.lax.platform_dependent(
        *arguments, cpu=lambda *arrays: call(name, result, *arrays), default=on_device
    )


def sort_keys(keys: UInt32[Array, "n"], where: str = "host") -> UInt32[Array, "n"]:
    """The keys in ascending order. `where` is a plan's `sort`: "host", or "device" for XLA's own sort."""
    return _either("gsjax_sort", where, jnp.sort, jax.ShapeDtypeStruct(keys.shape, jnp.uint32), keys)


def argsort_keys(keys: UInt32[Array, "n"], where: str = "host") -> Int[Array, "n"]:
    """The stable order of the keys. `where` as in `sort_keys`."""

    def on_device(keys):
        return jnp.argsort(keys, stable=True).astype(jnp.int32)

    return _either("gsjax_argsort", where, on_device, jax.ShapeDtypeStruct(keys.shape, jnp.int32), keys)


def running_sum(counts: Int[Array, "n"], where: str = "host") -> Int[Array, "n"]:
    """Sums of the first 1, 2, ... n counts, modulo 2^32. `where` as in `sort_keys`."""
    result = jax.ShapeDtypeStruct(counts.shape, jnp.int32)
    return _either("gsjax_running_sum", where, jnp.cumsum, result, counts)


def repeat(
    values: Int[Array, "n"] | UInt32[Array, "n"], starts: Int[Array, "n"], length: int, where: str = "host"
) -> Array:
    """[length]: `values[i]` from `starts[i]` to the next start. `where` as in `sort_keys`.

    Args:
        values: any values; their differences may wrap.
        starts: non-decreasing. If several values start at the same place, the last one counts.
        length: length of the result; values that start beyond it are left out.
    """

    def on_device(values, starts):
        steps = jnp.diff(values, prepend=jnp.zeros(1, values.dtype))
        summed = jnp.zeros(length, values.dtype).at[starts].add(steps, mode="drop")
        return jnp.cumsum(summed, dtype=values.dtype)

    return _either(
        "gsjax_repeat", where, on_device, jax.ShapeDtypeStruct((length,), values.dtype), values, starts
    )
