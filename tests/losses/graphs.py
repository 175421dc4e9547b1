"""Small graphs shared by tests of graphs and their losses."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np

from gsjax.losses.edges import (
    Edges,
    Matching,
    affinities,
    edge_affinities,
    edge_weights,
    similar_edges,
    spatial_edges,
    temporal_edges,
)
from gsjax.losses.sinkhorn import sinkhorn

T, N, D = 3, 8, 5
TAU_X, TAU_T = 0.8, 1.5
MATCHING = Matching()
SEEDS = st.integers(0, 1000)


def case(seed: int) -> dict[str, np.ndarray]:
    """Positions, a teacher's features and trained features; some nodes are absent."""
    random = np.random.default_rng(seed)
    return {
        "positions": random.normal(size=(T, N, 3)),
        "teacher": random.normal(size=(T, N, D)),
        "features": random.normal(size=(T, N, D)),
        "times": np.cumsum(random.uniform(0.1, 1, T)),
        "valid": random.permuted(np.arange(N) < [[N], [N - 2], [N - 1]], axis=1),
    }


def arrays(case):
    return {name: jnp.asarray(a) for name, a in case.items()}


@jax.jit
def graph(positions, teacher, times, valid, **_):
    """Edges to nearest and matching nodes, their weights and affinities, and edges to similar nodes."""
    edges = spatial_edges(positions, 3, valid) | temporal_edges(teacher, 2, 2, valid)
    weights = edge_weights(positions, teacher, times, edges, TAU_X, TAU_T)
    alike = similar_edges(teacher, 2, 0, valid), similar_edges(teacher, 2, 1, valid)
    return edges, weights, edge_affinities(teacher, edges, valid), alike


matrices = jax.jit(affinities, static_argnums=1)
edge_values = jax.jit(edge_affinities)
matching_of = jax.jit(sinkhorn)


def listed(edges: Edges) -> set[tuple[int, int, int, int]]:
    """(frame, node, frame, node) of each edge."""
    nodes = np.asarray(edges.nodes)
    found = np.argwhere(np.asarray(edges.valid)).tolist()
    return {(t, i, t + edges.offsets[e], int(nodes[t, i, e])) for t, i, e in found}


def cosine(u, v):
    return u @ v / np.linalg.norm(u) / np.linalg.norm(v)
