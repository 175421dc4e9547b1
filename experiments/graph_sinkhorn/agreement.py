"""Is our Sinkhorn ott-jax's, and how long does it take beside it?

Affinities of nodes of two frames: layer-normalised features of 32 channels, changed by half their size from
one to the other, in 20 iterations of rows and columns each.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from ott.geometry.geometry import Geometry
from ott.problems.linear.linear_problem import LinearProblem
from ott.solvers.linear.implicit_differentiation import ImplicitDiff
from ott.solvers.linear.sinkhorn import Sinkhorn

from experiments.shared.timing import jitted, timed
from gsjax.losses.sinkhorn import sinkhorn

CHANNELS, ITERATIONS, MANY, PAIRS = 32, 20, 100, 15


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """So many nodes, one derivative."""
    scores, weights = drawn(options["nodes"], seed)
    derivative = options["derivative"]
    ours = partial(sinkhorn, temperature=1.0, derivative=derivative)
    others = partial(ott, implicit=derivative == "implicit")
    values = {"ours": jitted(ours), "ott": jitted(others)}
    slopes = {name: jitted(jax.grad(loss(f))) for name, f in (("ours", ours), ("ott", others))}
    (found, theirs), value_ms, value_ratio = beside(values, jnp.asarray(scores))
    (slope, their_slope), slope_ms, slope_ratio = beside(slopes, jnp.asarray(scores), jnp.asarray(weights))
    return {
        "difference": np.abs(found - theirs).max(),
        "converged_difference": converged_difference(ours, others, scores),
        "slope_difference": np.abs(slope - their_slope).max() / np.abs(their_slope).max(),
        "rows_off": np.abs(found.sum(axis=1) - 1).max(),
        "value_ms": value_ms[0],
        "ott_value_ms": value_ms[1],
        "value_ratio": value_ratio,
        "slope_ms": slope_ms[0],
        "ott_slope_ms": slope_ms[1],
        "slope_ratio": slope_ratio,
    }


def drawn(nodes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Scores, and what a loss would ask of each affinity."""
    random = np.random.default_rng(seed)
    features = random.normal(size=(nodes, CHANNELS))
    frames = np.stack([features, features + 0.5 * random.normal(size=features.shape)])
    frames -= frames.mean(axis=2, keepdims=True)
    frames /= frames.std(axis=2, keepdims=True)
    scores = frames[0] @ frames[1].T / np.sqrt(CHANNELS)
    return scores.astype(np.float32), random.normal(size=scores.shape).astype(np.float32)


def ott(scores: jax.Array, implicit: bool, iterations: int = ITERATIONS) -> jax.Array:
    """Theirs, in the same order: it begins with what it has for columns, so rows are given as those."""
    masses = jnp.ones(len(scores), scores.dtype)
    problem = LinearProblem(Geometry(-scores.T, epsilon=1.0), masses, masses)
    solver = Sinkhorn(
        threshold=-1.0,  # no end before the last iteration
        inner_iterations=iterations,
        min_iterations=iterations,
        max_iterations=iterations,
        implicit_diff=ImplicitDiff() if implicit else None,
    )
    return solver(problem).matrix.T


def loss(matching: Callable) -> Callable:
    def weighted(scores, weights):
        return jnp.vdot(weights, matching(scores))

    return weighted


def beside(functions: dict[str, Callable], *arguments: jax.Array) -> tuple[list, list[float], float]:
    """What both give, their median times, and the median ratio of calls one right after the other."""
    found = [np.asarray(timed(f, *arguments)[0]) for f in functions.values()]  # compiles
    times = np.array([[timed(f, *arguments)[1] for f in functions.values()] for _ in range(PAIRS)])
    return found, np.median(times, axis=0).tolist(), float(np.median(times[:, 0] / times[:, 1]))


def converged_difference(ours: Callable, others: Callable, scores: np.ndarray) -> float:
    with jax.enable_x64(True):
        double = jnp.asarray(scores, jnp.float64)
        found, theirs = (jitted(partial(f, iterations=MANY))(double) for f in (ours, others))
        return float(jnp.abs(found - theirs).max())
