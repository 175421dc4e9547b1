"""Points picked from many, so that few stand for all."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Sample(NamedTuple):
    """Points picked from many: their indices, and False where none was left to pick."""

    indices: Int[Array, "count"]
    valid: Bool[Array, "count"]


def farthest_points(points: Float[Array, "n c"], count: int, valid: Bool[Array, "n"] | None = None) -> Sample:
    """Points that cover all: the one farthest from the mean, then always the one farthest from those picked.
    So none is farther from the nearest picked one than any two of those are from each other.

    Args:
        points: positions. One that is not finite is not picked, nor a second one at the same place.
        count: how many.
        valid: which may be picked; all unless given.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"count={count}: expected 1 or more")
    there = jnp.isfinite(points).all(axis=-1)
    there = there if valid is None else there & valid
    points = jnp.where(there[:, None], points, 0.0)  # 0 times NaN would spread
    axes, places = tuple(points.T), jnp.arange(len(points))
    mean = points.sum(axis=0) / jnp.maximum(there.sum(), 1)

    # A sum over a short last axis, and argmax, would take seven times as long on a CPU.
    def squared_to(point):
        return sum((axis - at) ** 2 for axis, at in zip(axes, point, strict=True))

    def farthest(apart):
        return jnp.min(jnp.where(apart == apart.max(), places, len(points) - 1))

    def pick(carry, _):
        apart, picked, found = carry
        apart = jnp.minimum(apart, squared_to(points[picked]))
        following = farthest(apart)
        return (apart, following, apart[following] > 0), (picked, found)

    first = farthest(jnp.where(there, squared_to(mean), -1.0))
    start = jnp.where(there, jnp.inf, -1.0).astype(points.dtype), first, there.any()
    return Sample(*jax.lax.scan(pick, start, length=count)[1])
