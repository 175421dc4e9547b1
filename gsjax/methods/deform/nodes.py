"""Nodes: Gaussians far apart from each other, at which a deformation field is evaluated. On the host."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import cKDTree

from gsjax.geometry.sampling import farthest_points
from gsjax.scene.deformation import Nodes
from gsjax.scene.gaussians import Gaussians, take

_BLENDED = 4


def farthest_rows(means: Float[Array | np.ndarray, "n 3"], count: int) -> Int[np.ndarray, "_"]:
    """Rows of up to `count` Gaussians that lie far from each other, by farthest-point sampling."""
    sample = jax.jit(farthest_points, static_argnums=1)(jnp.asarray(means), min(count, len(means)))
    return np.asarray(sample.indices)[np.asarray(sample.valid)]


def nodes_of(gaussians: Gaussians, count: int, groups: Int[np.ndarray, "n"] | None = None) -> Nodes:
    """Nodes on Gaussians that lie far from each other; each Gaussian blends the four nearest.

    The weights are a Gaussian of the distance, whose width is the distance to the second nearest node, minus
    the weight of the fourth, so that a node's weight vanishes where it ceases to be among the four.

    Args:
        gaussians: canonical Gaussians.
        count: number of nodes, at most that of Gaussians; with groups, the number in each.
        groups: group of each Gaussian, such as a tracker's rigid bodies: a Gaussian then blends nodes of its
            own group only, as its neighbours in other groups may move away.
    """
    if groups is not None:
        return _nodes_of_groups(gaussians, count, groups)
    means = np.asarray(gaussians.means)
    chosen = farthest_rows(means, count)
    nearest = min(_BLENDED, len(chosen))
    distances, indices = cKDTree(means[chosen]).query(means, k=[*range(1, nearest + 1)])
    width = np.maximum(distances[:, min(1, nearest - 1)], 1e-12)[:, None]
    weights = np.exp(-np.square(distances / width))
    weights = np.maximum(weights - np.where(nearest > 1, weights[:, -1:], 0.0), 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    return _on_device(chosen, indices, weights, gaussians)


def _nodes_of_groups(gaussians: Gaussians, count: int, groups: Int[np.ndarray, "n"]) -> Nodes:
    """Nodes of all groups; a blend of fewer than four is padded with its nearest, at weights of 0."""
    indices = np.zeros((gaussians.num, _BLENDED), np.int32)
    weights = np.zeros((gaussians.num, _BLENDED), np.float32)
    chosen: list[int] = []
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        found = nodes_of(take(gaussians, rows), count)
        blended = found.indices.shape[1]
        indices[rows] = len(chosen) + np.asarray(found.indices)[:, :1]
        indices[rows, :blended] = len(chosen) + np.asarray(found.indices)
        weights[rows, :blended] = found.weights
        chosen += rows[np.asarray(found.rows)].tolist()
    return _on_device(chosen, indices, weights, gaussians)


def _on_device(rows, indices, weights, gaussians: Gaussians) -> Nodes:
    rows, indices = jnp.asarray(rows, jnp.int32), jnp.asarray(indices, jnp.int32)
    return Nodes(rows, indices, jnp.asarray(weights, gaussians.means.dtype))
