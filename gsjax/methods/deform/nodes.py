"""The places at which a deformation field is evaluated. On the host."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from scipy.spatial import cKDTree

from gsjax.geometry.sampling import farthest_points
from gsjax.scene.deformation import Nodes
from gsjax.scene.gaussians import Gaussians, take

_BLENDED = 4


def nodes_of(gaussians: Gaussians, count: int, groups: Int[np.ndarray, "n"] | None = None) -> Nodes:
    """Nodes on Gaussians that lie far from each other, of which each Gaussian blends the four nearest.

    Their weights fall like a Gaussian of the distance, as wide as the distance to the second nearest, less
    what the farthest of the four would have: so a node's pull ends where it is no longer among the four.

    Args:
        gaussians: canonical.
        count: number of nodes, at most, for there are no more than Gaussians. With groups, that of each.
        groups: of Gaussians that move as one, by a tracker, say: a Gaussian then blends nodes of its own
            group alone, for what is next to it now may be elsewhere later.
    """
    if groups is not None:
        return _nodes_of_groups(gaussians, count, groups)
    means = np.asarray(gaussians.means)
    sample = jax.jit(farthest_points, static_argnums=1)(jnp.asarray(means), min(count, len(means)))
    chosen = np.asarray(sample.indices)[np.asarray(sample.valid)]
    nearest = min(_BLENDED, len(chosen))
    distances, indices = cKDTree(means[chosen]).query(means, k=[*range(1, nearest + 1)])
    width = np.maximum(distances[:, min(1, nearest - 1)], 1e-12)[:, None]
    weights = np.exp(-np.square(distances / width))
    weights = np.maximum(weights - np.where(nearest > 1, weights[:, -1:], 0.0), 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    return Nodes(
        jnp.asarray(chosen, jnp.int32),
        jnp.asarray(indices, jnp.int32),
        jnp.asarray(weights, gaussians.means.dtype),
    )


def _nodes_of_groups(gaussians: Gaussians, count: int, groups: Int[np.ndarray, "n"]) -> Nodes:
    """Those of each group, side by side; a blend of fewer than four is filled up with weights of 0."""
    indices = np.zeros((gaussians.num, _BLENDED), np.int32)
    weights = np.zeros((gaussians.num, _BLENDED), np.float32)
    chosen: list[int] = []
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        found = nodes_of(take(gaussians, rows), count)
        blended = found.indices.shape[1]
        indices[rows, :blended] = len(chosen) + np.asarray(found.indices)
        weights[rows, :blended] = found.weights
        chosen += rows[np.asarray(found.rows)].tolist()
    return Nodes(
        jnp.asarray(chosen, jnp.int32), jnp.asarray(indices), jnp.asarray(weights, gaussians.means.dtype)
    )
