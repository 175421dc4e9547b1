"""Nodes, edges and affinities against their definitions, written as loops in float64."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial import cKDTree

from gsjax.losses.edges import Matching, all_edges, similar_edges, spatial_edges, temporal_edges
from tests.losses.graphs import (
    SEEDS,
    TAU_T,
    TAU_X,
    D,
    N,
    T,
    arrays,
    case,
    cosine,
    graph,
    listed,
    matching_of,
    matrices,
)

# -- edges ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_edges_are_those_of_loops_over_nodes(seed):
    inputs = case(seed)
    positions, teacher, valid = inputs["positions"], inputs["teacher"], inputs["valid"]
    edges, _, _, (within, across) = graph(**arrays(inputs))
    assert edges.nodes.shape == edges.valid.shape == (T, N, len(edges.offsets)) == (T, N, 3 + 4 * 2)
    matched = {o: np.asarray(matrices(jnp.asarray(teacher), o, jnp.asarray(valid))) for o in (1, 2)}
    want, alike = set(), {0: set(), 1: set()}
    for t, i in np.argwhere(valid).tolist():
        for s in range(T):
            others = [j for j in np.flatnonzero(valid[s]).tolist() if (s, j) != (t, i)]
            cosines = sorted(others, key=lambda j, s=s: -cosine(teacher[t, i], teacher[s, j]))[:2]
            if s == t:
                _, nearest = cKDTree(positions[t, others]).query(positions[t, i], 3)
                want |= {(t, i, t, others[j]) for j in nearest}
            else:
                row = matched[s - t][t, i] if s > t else matched[t - s][s, :, i]
                want |= {(t, i, s, j) for j in sorted(others, key=lambda j, row=row: -row[j])[:2]}
            if abs(s - t) < 2:
                alike[abs(s - t)] |= {(t, i, s, j) for j in cosines}
    assert listed(edges) == want
    assert listed(within) == alike[0]
    assert listed(across) == alike[1]


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_temporal_edges_find_the_order_in_which_nodes_come():
    random = np.random.default_rng(0)
    features, order = random.normal(size=(N, 16)), random.permutation(N)
    frames = jnp.asarray(np.stack([features, features[order]]))
    edges = temporal_edges(frames, 1, 1, matching=Matching(temperature=0.3))
    assert edges.offsets == (1, -1)
    np.testing.assert_array_equal(edges.nodes[0, :, 0], np.argsort(order))
    np.testing.assert_array_equal(edges.nodes[1, :, 1], order)
    assert edges.valid[0, :, 0].all()
    assert not edges.valid[0, :, 1].any()  # there is no frame before the first


@pytest.mark.thorough
def test_there_are_fewer_edges_than_requested_if_there_are_fewer_nodes():
    inputs = arrays(case(0))
    few = inputs["positions"][:, :3]
    near = spatial_edges(few, 5)
    assert near.nodes.shape == (T, 3, 5)
    assert (near.valid.sum(2) == 2).all()
    assert not spatial_edges(few[:, :1], 5).valid.any()
    assert temporal_edges(inputs["teacher"][:1], 2, 3).nodes.shape == (1, N, 0)  # no other frame
    assert all_edges(inputs["valid"][:1], 3).offsets == (0,) * N
    nothing = inputs["teacher"].at[:, 2].set(0.0).at[:, 3].set(jnp.nan)
    alike = similar_edges(nothing, 2, 1)
    ends = {node for _, i, _, j in listed(alike) for node in (i, j)}
    assert ends <= {*range(N)} - {2, 3}
    assert alike.valid.sum() == 2 * (T - 1) * (N - 2) * 2  # absent nodes displace no others


def test_all_edges_are_all_pairs():
    valid = case(1)["valid"]
    there = np.argwhere(valid).tolist()
    want = {(t, i, s, j) for t, i in there for s, j in there if abs(s - t) <= 1 and (t, i) != (s, j)}
    assert listed(all_edges(jnp.asarray(valid), 1)) == want


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_weights_and_affinities_are_those_of_each_edge(seed):
    inputs = case(seed)
    edges, *rest, _ = graph(**arrays(inputs))
    weights, found, nodes, there = map(np.asarray, (*rest, edges.nodes, edges.valid))
    positions, teacher, times = inputs["positions"], inputs["teacher"], inputs["times"]
    normal = teacher - teacher.mean(2, keepdims=True)
    normal /= np.sqrt((normal**2).mean(2, keepdims=True))
    for t, i, e in np.ndindex(T, N, len(edges.offsets)):
        s, j = t + edges.offsets[e], nodes[t, i, e]
        if not there[t, i, e]:
            assert weights[t, i, e] == 0
            continue
        want = np.exp(-((positions[t, i] - positions[s, j]) ** 2).sum() / TAU_X**2)
        want *= max(0, cosine(teacher[t, i], teacher[s, j])) * np.exp(-abs(times[t] - times[s]) / TAU_T)
        np.testing.assert_allclose(weights[t, i, e], want, rtol=1e-9)
    for t, s in {(t, t + o) for t in range(T) for o in edges.offsets if 0 <= t + o < T}:
        first, last = sorted((t, s))
        scores = normal[first] @ normal[last].T
        if t == s:
            np.fill_diagonal(scores, -np.inf)
        rows, columns = map(jnp.asarray, inputs["valid"][[first, last]])
        matrix = np.asarray(matching_of(jnp.asarray(scores), np.sqrt(D), rows=rows, columns=columns))
        choices = inputs["valid"][s].sum() - (s == t)
        for i, e in np.argwhere(there[t] & (np.array(edges.offsets) == s - t)):
            pair = (i, nodes[t, i, e]) if s >= t else (nodes[t, i, e], i)
            np.testing.assert_allclose(found[t, i, e], choices * matrix[pair], rtol=1e-9)
