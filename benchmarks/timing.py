"""Timing of calls: compiled separately, on changing inputs, waiting for the results, repeatedly."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

MAX_SECONDS = 20.0  # for all timed calls of one program
MIN_CALLS = 3


class Compiled(NamedTuple):
    """A compiled program, with the statistics of its compilation."""

    run: Callable
    seconds: float  # of tracing and compiling
    memory: int  # bytes of arguments, outputs and temporaries
    traffic: int  # bytes of arguments and outputs


def compile_program(function: Callable, *args: Any, options: dict[str, Any] | None = None) -> Compiled:
    """Compile `function` for these arguments, with compiler options, or by default like a plain `jax.jit`."""
    jax.clear_caches()  # traces shared with an earlier program would make this one look cheap
    began = time.perf_counter()
    run = jax.jit(function).lower(*args).compile(options)
    seconds = time.perf_counter() - began
    sizes = run.memory_analysis()
    traffic = sizes.argument_size_in_bytes + sizes.output_size_in_bytes - sizes.alias_size_in_bytes
    return Compiled(run, seconds, traffic + sizes.temp_size_in_bytes, traffic)


def sample(call: Callable[[int], Any], repeats: int, max_seconds: float = MAX_SECONDS) -> list[float]:
    """Seconds of `call(0)`, `call(1)`, ..., including the wait for their results, after two warm-up calls.

    It stops early once `max_seconds` have passed, but not before three calls.
    """
    for i in (-2, -1):
        jax.block_until_ready(call(i))
    seconds: list[float] = []
    while len(seconds) < repeats:
        began = time.perf_counter()
        jax.block_until_ready(call(len(seconds)))
        seconds.append(time.perf_counter() - began)
        if sum(seconds) > max_seconds and len(seconds) >= MIN_CALLS:
            break
    return seconds


def median_and_p95(seconds: Sequence[float]) -> tuple[float, float]:
    """Both in milliseconds."""
    median, p95 = np.percentile(np.asarray(seconds) * 1e3, [50, 95])
    return float(median), float(p95)


def perturbed_means(means: np.ndarray, rng: np.random.Generator, relative: float) -> np.ndarray:
    """Means perturbed by `relative` of their coordinates, so that no two timed calls have the same inputs."""
    return (means * (1 + relative * rng.normal(size=means.shape))).astype(means.dtype)


def perturbed_viewmat(viewmat: np.ndarray, rng: np.random.Generator, relative: float) -> np.ndarray:
    """A rigid view rotated by about `relative` radians about each axis and shifted, relatively, by as
    much."""
    rotation = viewmat[:3, :3] + relative * hat(rng.normal(size=3)) @ viewmat[:3, :3]
    u, _, vt = np.linalg.svd(rotation.astype(np.float64))
    moved = viewmat.copy()
    moved[:3, :3] = u @ vt
    moved[:3, 3] = viewmat[:3, 3] * (1 + relative * rng.normal(size=3))
    return moved


def hat(vector: np.ndarray) -> np.ndarray:
    """The matrix of the cross product with `vector`."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def pose_tangent(viewmat: np.ndarray, axis: int) -> np.ndarray:
    """The derivative of exp(t e_axis) viewmat at t = 0: translations along x, y, z, then rotations."""
    generator = np.zeros((4, 4))
    if axis < 3:
        generator[axis, 3] = 1.0
    else:
        generator[:3, :3] = hat(np.eye(3)[axis - 3])
    return (generator @ viewmat).astype(viewmat.dtype)
