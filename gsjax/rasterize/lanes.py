"""Long arrays as rows of 256: the shape in which XLA:CPU both vectorises a loop and splits it over cores.

It splits the outermost axis of a computation, at bounds known only at run time. For an array with one axis
that leaves no loop whose length the compiler knows, and the code is scalar, five times as slow.
"""

import jax.numpy as jnp
from jaxtyping import Array, Int

LANES = 256


def in_lanes(a: Array) -> Array:
    """[n] as [ceil(n / 256), 256], padded with zeros."""
    return jnp.pad(a, (0, -a.shape[0] % LANES)).reshape(-1, LANES)


def columns_in_lanes(a: Array) -> list[Array]:
    """The columns of [n, k] separately, each in lanes."""
    return [in_lanes(a[:, i]) for i in range(a.shape[1])]


def flat(a: Array, n: int) -> Array:
    """The first `n` numbers of an array in lanes [rows, 256]: the inverse of `in_lanes`."""
    return a.reshape(-1)[:n]


def slots(n: int) -> Int[Array, "rows 256"]:
    """0 to n - 1 (and a little beyond, so that the last row is full) in lanes."""
    return jnp.arange(-(-n // LANES) * LANES, dtype=jnp.int32).reshape(-1, LANES)
