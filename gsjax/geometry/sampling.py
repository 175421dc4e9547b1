"""Farthest point sampling: a few points that represent many."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Sample(NamedTuple):
    """Sampled points: their indices, and whether each is valid; False once no point was left to sample."""

    indices: Int[Array, "count"]
    valid: Bool[Array, "count"]


def farthest_points(points: Float[Array, "n c"], count: int, valid: Bool[Array, "n"] | None = None) -> Sample:
    """Farthest point sampling: the point farthest from the mean, then repeatedly the one farthest from those
    sampled. So no point is farther from its nearest sample than any two samples are from each other.

    Args:
        points: positions. Points that are not finite are never sampled, nor are duplicates.
        count: number of samples, static.
        valid: points that may be sampled; default: all.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected 1 or more, found {count}")
    there = jnp.isfinite(points).all(axis=-1)
    there = there if valid is None else there & valid
    points = jnp.where(there[:, None], points, 0.0)  # 0 times NaN would spread
    axes, places = tuple(points.T), jnp.arange(len(points))
    mean = points.sum(axis=0) / jnp.maximum(there.sum(), 1)

    # On a CPU, argmax and a sum over a short last axis would take seven times as long.
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
