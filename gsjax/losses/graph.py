"""What a teacher asks of features that learn, over a graph of nodes and frames (SurstSplat, section 2.3, and
GaussianClin, section 3.3).

`gsjax.losses.edges` makes edges, their weights and the affinities wanted, once. Then, of features that learn,

    loss = 0.1 * node_loss(features, teacher) + 0.1 * structure_loss(features, wanted, edges, weights)

`features` and `teacher` are projections to as many channels. That of the Gaussians' features may learn; the
teacher's is fixed (`orthonormal_projection`), for two that learn agree best where both are 0. Losses are
means and not sums, so that their weights do not depend on how many nodes and edges there are.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from gsjax.losses.edges import (
    Edges,
    Features,
    Matching,
    There,
    edge_affinities,
    edge_cosines,
    live_edges,
    present,
)
from gsjax.losses.photometric import weighted_mean


def orthonormal_projection(key: PRNGKeyArray, channels: int, width: int) -> Float[Array, "width channels"]:
    """A random map of `channels` numbers to `width`, for a teacher's features: V = F W^T. Its rows are
    orthonormal, or its columns where `width` is the larger.

    Args:
        key: another one gives another map.
        channels: of the teacher.
        width: of what comes out.
    """
    return jax.nn.initializers.orthogonal()(key, (width, channels))


def node_loss(
    features: Float[Array, "*nodes d"],
    teacher: Float[Array, "*nodes d"],
    valid: Bool[Array, "*nodes"] | None = None,
) -> Float[Array, ""]:
    """L_node (eq. 11): the mean over nodes of |V^G - V^F|.

    Args:
        features: V^G, those that learn.
        teacher: V^F, which gets no gradient.
        valid: which nodes are there; all unless given.
    """
    teacher, known = present(jax.lax.stop_gradient(teacher), valid)
    features, there = present(features, known)
    squared = jnp.where(there, jnp.sum((features - teacher) ** 2, axis=-1), 0.0)
    apart = squared > 0  # where not, a length has no slope
    return weighted_mean(jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0), there * 1.0)


def structure_loss(
    features: Features,
    wanted: Float[Array, "t n e"],
    edges: Edges,
    weights: Float[Array, "t n e"] | None = None,
    valid: There | None = None,
    matching: Matching = Matching(),
) -> Float[Array, ""]:
    """L_mat (eq. 12): the mean over edges of how far affinities of `features` are from those wanted.

    No gradient reaches `wanted` and `weights`: a graph asks something of features, and does not move nodes.
    Over `all_edges` without weights it is the mean L1 distance between rows of A, 0 to 2.

    Args:
        features: those that learn.
        edges: of the graph.
        wanted: the teacher's, from `edge_affinities`.
        weights: of edges, from `edge_weights`; all alike unless given.
        valid: which nodes are there; all unless given.
        matching: how features become affinities, as for `wanted`.
    """
    features, there = present(features, valid)
    live = live_edges(edges, there) * 1.0
    weights = live if weights is None else jax.lax.stop_gradient(weights) * live
    found = edge_affinities(features, edges, there, matching)
    return weighted_mean(jnp.abs(found - jax.lax.stop_gradient(wanted)), weights)


def similarity_loss(features: Features, edges: Edges, valid: There | None = None) -> Float[Array, ""]:
    """The mean over edges of (1 - cos)^2 (GaussianClin, eq. 8), without those of a feature of length 0.

    L_s and L_t are this of `similar_edges` of the teacher, within frames and with a window, each with its own
    weight. Features that are all alike have no such loss: something else has to tell them apart.

    Args:
        features: those that learn.
        edges: between nodes that are to be alike.
        valid: which nodes are there; all unless given.
    """
    features, there = present(features, valid)
    cosines, known = edge_cosines(features, edges, there)
    return weighted_mean((1 - cosines) ** 2, known * 1.0)
