"""Losses of graphs against what they mean, written out in float64; central differences; extremes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from gsjax.losses.edges import Matching, affinities, all_edges, edge_affinities, temporal_edges
from gsjax.losses.graph import node_loss, orthonormal_projection, similarity_loss, structure_loss
from tests.losses.graphs import (
    MATCHING,
    SEEDS,
    D,
    N,
    T,
    arrays,
    case,
    cosine,
    edge_values,
    graph,
    listed,
)


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
