"""How long a jitted function takes, for experiments; `benchmarks` has what is compared between machines."""

from collections.abc import Callable
from time import perf_counter
from typing import Any

import jax
import numpy as np

from gsjax.optim.compiler import host_options

CALLS = 7


def jitted(function: Callable, **options: Any) -> Callable:
    """Compiled as the methods' own loops are."""
    return jax.jit(function, compiler_options=host_options() or None, **options)


def timed(function: Callable, *arguments: Any, **options: Any) -> tuple[Any, float]:
    """What the function gives, and milliseconds."""
    begun = perf_counter()
    result = jax.block_until_ready(function(*arguments, **options))
    return result, 1e3 * (perf_counter() - begun)


def median_ms(function: Callable, *arguments: Any, **options: Any) -> float:
    """Of several calls after one that compiles."""
    timed(function, *arguments, **options)
    return float(np.median([timed(function, *arguments, **options)[1] for _ in range(CALLS)]))
