"""Graphs and their losses against what they mean, written out in loops in float64; central differences."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from gsjax.losses.graph import (
    Edges,
    Matching,
    affinities,
    all_edges,
    edge_affinities,
    edge_weights,
    farthest_points,
    node_loss,
    orthonormal_projection,
    similar_edges,
    similarity_loss,
    spatial_edges,
    structure_loss,
    temporal_edges,
)
from gsjax.losses.sinkhorn import sinkhorn

T, N, D = 3, 8, 5
TAU_X, TAU_T = 0.8, 1.5
MATCHING = Matching()
SEEDS = st.integers(0, 1000)


def case(seed: int) -> dict[str, np.ndarray]:
    """Positions, a teacher's features and those that learn; some nodes are absent."""
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
    """Nearest, matched and similar ones."""
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


# -- nodes ---------------------------------------------------------------------------------------------------

pick = jax.jit(farthest_points, static_argnums=1)


@pytest.mark.usefixtures("x64")
@given(SEEDS, st.integers(1, 12))
def test_picked_points_cover_the_others_and_keep_apart(seed, there):
    random = np.random.default_rng(seed)
    points, valid = random.normal(size=(12, 3)), random.permutation(12) < there
    points[~valid] *= 100
    points[np.nonzero(~valid)[0][:1]] = np.nan
    sample = pick(jnp.asarray(points), 5, jnp.asarray(valid))
    picked = np.asarray(sample.indices)[np.asarray(sample.valid)]
    assert len(set(picked)) == len(picked) == min(there, 5)
    assert valid[picked].all()
    center = points[valid].mean(0)
    far = np.where(valid, np.linalg.norm(points - center, axis=1), -1)
    np.testing.assert_allclose(far[picked[0]], far.max())  # of two, both are as far from their middle
    for i in range(1, len(picked)):  # each is the farthest from those before it
        apart = np.where(valid, cdist(np.nan_to_num(points), points[picked[:i]]).min(1), -1)
        np.testing.assert_allclose(apart[picked[i]], apart.max())


def test_points_at_one_place_are_picked_once_and_none_where_there_is_none():
    points = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])
    assert pick(points, 4, None).valid.tolist() == [True, True, False, False]
    assert pick(points[:1], 4, None).valid.tolist() == [True, False, False, False]
    assert not pick(points, 4, jnp.zeros(4, bool)).valid.any()
    assert not pick(points * jnp.nan, 4, None).valid.any()


# -- edges ---------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_edges_are_those_of_loops_over_nodes(seed):
    told = case(seed)
    positions, teacher, valid = told["positions"], told["teacher"], told["valid"]
    edges, _, _, (within, across) = graph(**arrays(told))
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
    assert not edges.valid[0, :, 1].any()  # nothing is before the first


def test_there_are_fewer_edges_than_asked_for_where_there_are_fewer_nodes():
    told = arrays(case(0))
    few = told["positions"][:, :3]
    near = spatial_edges(few, 5)
    assert near.nodes.shape == (T, 3, 5)
    assert (near.valid.sum(2) == 2).all()
    assert not spatial_edges(few[:, :1], 5).valid.any()
    assert temporal_edges(told["teacher"][:1], 2, 3).nodes.shape == (1, N, 0)  # no other frame
    assert all_edges(told["valid"][:1], 3).offsets == (0,) * N
    nothing = told["teacher"].at[:, 2].set(0.0).at[:, 3].set(jnp.nan)
    alike = similar_edges(nothing, 2, 1)
    ends = {node for _, i, _, j in listed(alike) for node in (i, j)}
    assert ends <= {*range(N)} - {2, 3}
    assert alike.valid.sum() == 2 * (T - 1) * (N - 2) * 2  # and those take no one's place


def test_all_edges_are_all_pairs():
    valid = case(1)["valid"]
    there = np.argwhere(valid).tolist()
    want = {(t, i, s, j) for t, i in there for s, j in there if abs(s - t) <= 1 and (t, i) != (s, j)}
    assert listed(all_edges(jnp.asarray(valid), 1)) == want


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_weights_and_affinities_are_those_of_each_edge(seed):
    told = case(seed)
    edges, *rest, _ = graph(**arrays(told))
    weights, found, nodes, there = map(np.asarray, (*rest, edges.nodes, edges.valid))
    positions, teacher, times = told["positions"], told["teacher"], told["times"]
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
        rows, columns = map(jnp.asarray, told["valid"][[first, last]])
        matrix = np.asarray(matching_of(jnp.asarray(scores), np.sqrt(D), rows=rows, columns=columns))
        choices = told["valid"][s].sum() - (s == t)
        for i, e in np.argwhere(there[t] & (np.array(edges.offsets) == s - t)):
            pair = (i, nodes[t, i, e]) if s >= t else (nodes[t, i, e], i)
            np.testing.assert_allclose(found[t, i, e], choices * matrix[pair], rtol=1e-9)


# -- losses --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_losses_are_means_over_nodes_and_edges(seed):
    told = case(seed)
    given_ = arrays(told)
    edges, weights, wanted, (within, across) = graph(**given_)
    features, teacher, valid = told["features"], told["teacher"], told["valid"]
    found = np.asarray(edge_values(given_["features"], edges, given_["valid"]))
    apart = np.abs(found - np.asarray(wanted))
    want = [
        np.linalg.norm(features - teacher, axis=2)[valid].mean(),
        np.average(apart, weights=weights),
        apart[np.asarray(edges.valid)].mean(),
        *(
            np.mean([(1 - cosine(features[t, i], features[s, j])) ** 2 for t, i, s, j in listed(alike)])
            for alike in (within, across)
        ),
    ]
    np.testing.assert_allclose(compiled(given_["features"], given_), want, rtol=1e-9)


def losses(features, told, matching=MATCHING):
    """All of them, of nodes that learn."""
    edges, weights, wanted, (within, across) = graph(**told)
    return jnp.stack(
        [
            node_loss(features, told["teacher"], told["valid"]),
            structure_loss(features, wanted, edges, weights, told["valid"], matching),
            structure_loss(features, wanted, edges, None, told["valid"], matching),
            similarity_loss(features, within, told["valid"]),
            similarity_loss(features, across, told["valid"]),
        ]
    )


compiled = jax.jit(losses, static_argnums=2)
slopes_of = jax.jit(jax.jacrev(losses), static_argnums=2)


@pytest.mark.usefixtures("x64")
def test_all_pairs_are_compared_by_the_l1_distance_of_rows():
    told, apart = arrays(case(2)), []
    for t, s in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2)):
        ours, theirs = (affinities(told[name], s - t, told["valid"])[t] for name in ("features", "teacher"))
        for axis in (1,) if s == t else (1, 0):
            choices = told["valid"][s if axis == 1 else t].sum() - (s == t)
            rows = told["valid"][t if axis == 1 else s]
            apart += [(choices, d) for d in np.abs(ours - theirs).sum(axis)[np.asarray(rows)]]
    choices, distances = np.array(apart).T
    assert distances.max() < 2
    edges = all_edges(told["valid"], 1)
    wanted = edge_values(told["teacher"], edges, told["valid"])
    found = jax.jit(structure_loss)(told["features"], wanted, edges, None, told["valid"])
    np.testing.assert_allclose(found, np.average(distances, weights=choices), rtol=1e-9)


@pytest.mark.usefixtures("x64")
def test_features_like_the_teachers_have_no_loss_and_the_teacher_and_the_graph_no_slope():
    told = arrays(case(3))
    none = compiled(told["teacher"], told)[:3]
    np.testing.assert_allclose(none, 0, atol=1e-9)
    structure = compiled(3 * told["teacher"] - 2, told)[1:3]  # affinities know no scale and no shift
    np.testing.assert_allclose(structure, 0, atol=1e-9)
    assert (compiled(told["features"], told) > 1e-2).all()

    def of_teacher(positions, teacher):
        return losses(told["features"], told | {"positions": positions, "teacher": teacher}).sum()

    for slope in jax.jit(jax.grad(of_teacher, (0, 1)))(told["positions"], told["teacher"]):
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("derivative", ["unrolled", "implicit"])
def test_slopes_are_those_of_central_differences_and_jvp_agrees_with_vjp(derivative):
    told, matching = arrays(case(4)), Matching(iterations=60, derivative=derivative)
    along = jnp.asarray(np.random.default_rng(5).normal(size=(T, N, D)))
    slopes = slopes_of(told["features"], told, matching)
    ahead, behind = (compiled(told["features"] + step * along, told, matching) for step in (1e-6, -1e-6))
    by_slope = (slopes * along).sum((1, 2, 3))
    np.testing.assert_allclose(by_slope, (ahead - behind) / 2e-6, rtol=1e-6)
    by_jvp = jax.jvp(lambda f: compiled(f, told, matching), (told["features"],), (along,))[1]
    np.testing.assert_allclose(by_jvp, by_slope, rtol=1e-9)
    assert (slopes[:, ~told["valid"]] == 0).all()
    assert (np.abs(slopes).max((1, 2, 3)) > 1e-3).all()


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_another_order_of_nodes_changes_no_loss(seed):
    told = arrays(case(seed))
    order = np.random.default_rng(seed).permutation(N)
    other = {name: a[:, order] if a.ndim > 1 else a for name, a in told.items()}
    np.testing.assert_allclose(
        compiled(other["features"], other), compiled(told["features"], told), rtol=1e-8
    )


@pytest.mark.usefixtures("x64")
def test_twice_the_nodes_change_no_loss():
    told = arrays(case(6))
    twice = {name: jnp.concatenate([a, a], axis=1) if a.ndim > 1 else a for name, a in told.items()}

    @jax.jit
    def across(told):  # in one frame each has a twin, which it lacks among half of them
        edges = all_edges(told["valid"], 1)
        wanted = edge_affinities(told["teacher"], edges, told["valid"])
        between = jnp.broadcast_to(np.array(edges.offsets) != 0, edges.valid.shape) * 1.0
        nodes = node_loss(told["features"], told["teacher"], told["valid"])
        return nodes, structure_loss(told["features"], wanted, edges, between, told["valid"])

    np.testing.assert_allclose(across(twice), across(told), rtol=1e-9)


# -- extremes ------------------------------------------------------------------------------------------------


def extreme(name: str):
    told = {k: jnp.asarray(a, bool if k == "valid" else jnp.float32) for k, a in case(7).items()}
    if name == "no features":
        told["features"] = told["teacher"] = jnp.zeros((T, N, D))
    elif name == "features all alike":
        told["features"] = told["teacher"] = jnp.ones((T, N, D))
    elif name == "one node":
        told["valid"] = jnp.zeros((T, N), bool).at[1, 2].set(True)
        told["teacher"] = told["features"]
    elif name == "no nodes":
        told["valid"] = jnp.zeros((T, N), bool)
    return told


@pytest.mark.parametrize("name", ["no features", "features all alike", "one node", "no nodes"])
def test_where_nothing_can_be_asked_losses_are_zero_without_a_slope(name):
    told = extreme(name)
    np.testing.assert_allclose(compiled(told["features"], told), 0, atol=1e-6)
    np.testing.assert_allclose(slopes_of(told["features"], told), 0, atol=1e-6)


def test_features_that_are_still_zero_learn_from_nodes_and_all_else_is_finite():
    told = extreme("")
    found, slopes = (f(jnp.zeros((T, N, D)), told) for f in (compiled, slopes_of))
    assert found[0] > 1
    assert (jnp.abs(slopes[0]).max(2) > 0)[told["valid"]].all()
    assert np.isfinite(found).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_array_equal(found[3:], 0)


def test_what_is_not_a_number_is_left_out_and_does_not_spread():
    told = extreme("")
    t, i = np.argwhere(told["valid"])[0]
    broken = told["features"].at[t, i].set(jnp.nan)
    found, slopes = (f(broken, told) for f in (compiled, slopes_of))
    assert np.isfinite(found).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_array_equal(slopes[:, t, i], 0)
    edges, weights, wanted, _ = graph(**told)
    ends_there = (np.arange(T)[:, None] + np.array(edges.offsets) == t)[:, None] & (edges.nodes == i)
    counted = jnp.where(ends_there, 0.0, weights).at[t, i].set(0.0)
    absent = told["valid"].at[t, i].set(False)
    one, other = (
        structure_loss(features, wanted, edges, weight, valid)
        for features, weight, valid in (
            (broken, weights, told["valid"]),
            (told["features"], counted, absent),
        )
    )
    np.testing.assert_allclose(one, other, rtol=1e-5)
    broken = told | {"teacher": told["teacher"].at[t, i].set(jnp.nan)}
    without = told | {"valid": absent}
    np.testing.assert_allclose(
        *(np.asarray(compiled(t["features"], t))[[0, 3, 4]] for t in (broken, without)), rtol=1e-5
    )


# -- the rest ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channels", "width"), [(9, 4), (4, 9), (6, 6)])
def test_a_teachers_projection_is_orthonormal_and_another_for_every_key(channels, width):
    one, other = (orthonormal_projection(jax.random.key(i), channels, width) for i in (0, 1))
    assert one.shape == (width, channels)
    gram = one @ one.T if width <= channels else one.T @ one
    np.testing.assert_allclose(gram, np.eye(min(channels, width)), atol=1e-5)
    assert jnp.abs(one - other).max() > 0.1


def test_a_batch_is_a_loop():
    many = [
        {k: jnp.asarray(a, bool if k == "valid" else jnp.float32) for k, a in case(i).items()} for i in (1, 2)
    ]
    stacked = jax.tree.map(lambda *a: jnp.stack(a), *many)
    together = jax.vmap(compiled)(stacked["features"], stacked)
    np.testing.assert_allclose(together, [compiled(one["features"], one) for one in many], rtol=1e-4)
    sampled = jax.vmap(lambda p: pick(p, 4, None))(many[0]["positions"])
    for t in range(T):
        np.testing.assert_array_equal(sampled.indices[t], pick(many[0]["positions"][t], 4, None).indices)


def test_float32_is_near_to_float64():
    told = case(8)
    single = compiled(*(lambda t: (t["features"], t))(arrays(told)))
    with jax.enable_x64(True):
        double = compiled(*(lambda t: (t["features"], t))(arrays(told)))
    np.testing.assert_allclose(single, double, rtol=1e-4)


def test_mistakes_are_named():
    told = arrays(case(0))
    with pytest.raises(ValueError, match=r"window=0.*1 frame or more"):
        temporal_edges(told["teacher"], 2, 0)
    with pytest.raises(ValueError, match=r"count=0.*1 or more"):
        farthest_points(told["positions"][0], 0)
