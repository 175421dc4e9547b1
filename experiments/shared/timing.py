"""Run times for experiments; `benchmarks` has those that are compared between machines."""

from collections.abc import Callable, Iterable
from time import perf_counter
from typing import Any

import jax
import numpy as np

from gsjax.engine.drive import Tick
from gsjax.optim.compiler import host_options

CALLS = 7


def jitted(function: Callable, **options: Any) -> Callable:
    """Compiled as the methods' own loops are."""
    return jax.jit(function, compiler_options=host_options() or None, **options)


def timed(function: Callable, *arguments: Any, **options: Any) -> tuple[Any, float]:
    """The result of a call, and its milliseconds."""
    begun = perf_counter()
    result = jax.block_until_ready(function(*arguments, **options))
    return result, 1e3 * (perf_counter() - begun)


def median_ms(function: Callable, *arguments: Any, **options: Any) -> float:
    """Median milliseconds of several calls, after one that compiles."""
    timed(function, *arguments, **options)
    return float(np.median([timed(function, *arguments, **options)[1] for _ in range(CALLS)]))


def run_through(ticks: Iterable[Tick]) -> tuple[float, float]:
    """Make all steps of a loop; none may be skipped.

    Returns:
        seconds of the steps, and seconds of compiling.

    Raises:
        AssertionError: a step was skipped.
    """
    seconds = compiling = skipped = 0.0
    for now in ticks:
        seconds, compiling = seconds + now.seconds, compiling + now.compile_seconds
        skipped += float(now.info["skipped"])
    assert not skipped, f"{skipped:.0f} steps were skipped"
    return seconds, compiling
