"""Losses between trained features and a teacher over a spatiotemporal graph (SurstSplat, section 2.3, and
GaussianClin, section 3.3).

`gsjax.losses.edges` computes edges, their weights and the wanted affinities once. Then, for trained features,

    loss = 0.1 * node_loss(features, teacher) + 0.1 * structure_loss(features, wanted, edges, weights)

`features` and `teacher` are projections to the same number of channels. The projection of the Gaussians'
features may be trained; the teacher's is fixed, say `jax.nn.initializers.orthogonal`, because two trained
projections agree best where both are 0. Losses are means and not sums, so that their weights do not depend
on the number of nodes and edges.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from gsjax.losses.edges import (
    Edges,
    Features,
    Matching,
    NodeMask,
    edge_affinities,
    edge_cosines,
    live_edges,
    present,
)
from gsjax.losses.photometric import weighted_mean


def node_loss(
    features: Float[Array, "*nodes d"],
    teacher: Float[Array, "*nodes d"],
    valid: Bool[Array, "*nodes"] | None = None,
) -> Float[Array, ""]:
    """L_node (eq. 11): the mean over nodes of |V^G - V^F|.

    Args:
        features: V^G, the trained features.
        teacher: V^F, which gets no gradient.
        valid: which nodes are present (default: all).
    """
    teacher, known = present(jax.lax.stop_gradient(teacher), valid)
    features, there = present(features, known)
    squared = jnp.where(there, jnp.sum((features - teacher) ** 2, axis=-1), 0.0)
    apart = squared > 0  # elsewhere the norm has no derivative
    return weighted_mean(jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0), there * 1.0)


def structure_loss(
    features: Features,
    wanted: Float[Array, "t n e"],
    edges: Edges,
    weights: Float[Array, "t n e"] | None = None,
    valid: NodeMask | None = None,
    matching: Matching = Matching(),
) -> Float[Array, ""]:
    """L_mat (eq. 12): the mean over edges of the absolute difference between the affinities of `features` and
    the wanted ones.

    No gradient reaches `wanted` and `weights`: the graph constrains features and does not move nodes. Over
    `all_edges` without weights it is the mean L1 distance between rows of A, 0 to 2.

    Args:
        features: the trained features.
        wanted: affinities of the teacher, from `edge_affinities`.
        edges: edges of the graph.
        weights: weights of the edges, from `edge_weights` (default: all equal).
        valid: which nodes are present (default: all).
        matching: how features become affinities, as for `wanted`.
    """
    features, there = present(features, valid)
    live = live_edges(edges, there) * 1.0
    weights = live if weights is None else jax.lax.stop_gradient(weights) * live
    found = edge_affinities(features, edges, there, matching)
    return weighted_mean(jnp.abs(found - jax.lax.stop_gradient(wanted)), weights)


def similarity_loss(features: Features, edges: Edges, valid: NodeMask | None = None) -> Float[Array, ""]:
    """The mean over edges of (1 - cos)^2 (GaussianClin, eq. 8), except edges of zero features.

    L_s and L_t are this loss over `similar_edges` of the teacher, within frames and with a window, each with
    its own weight. It is 0 for features that are all equal: another loss must separate them.

    Args:
        features: the trained features.
        edges: edges between nodes that should be similar.
        valid: which nodes are present (default: all).
    """
    features, there = present(features, valid)
    cosines, known = edge_cosines(features, edges, there)
    return weighted_mean((1 - cosines) ** 2, known * 1.0)
