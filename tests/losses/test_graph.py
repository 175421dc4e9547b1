"""Graph losses against their definitions in float64 and central differences, and at extremes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given

from gsjax.losses.edges import Matching, all_edges, edge_affinities, temporal_edges
from gsjax.losses.graph import node_loss, similarity_loss, structure_loss
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
    matrices,
)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_losses_are_means_over_nodes_and_edges(seed):
    inputs = case(seed)
    given_ = arrays(inputs)
    edges, weights, wanted, (within, across) = graph(**given_)
    features, teacher, valid = inputs["features"], inputs["teacher"], inputs["valid"]
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


def losses(features, inputs, matching=MATCHING):
    """All losses of trained node features."""
    edges, weights, wanted, (within, across) = graph(**inputs)
    return jnp.stack(
        [
            node_loss(features, inputs["teacher"], inputs["valid"]),
            structure_loss(features, wanted, edges, weights, inputs["valid"], matching),
            structure_loss(features, wanted, edges, None, inputs["valid"], matching),
            similarity_loss(features, within, inputs["valid"]),
            similarity_loss(features, across, inputs["valid"]),
        ]
    )


compiled = jax.jit(losses, static_argnums=2)
structure = jax.jit(structure_loss)
slopes_of = jax.jit(jax.jacrev(losses), static_argnums=2)


@pytest.mark.usefixtures("x64")
def test_all_pairs_are_compared_by_the_l1_distance_of_rows():
    inputs, apart = case(2), []
    for t, s in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2)):
        ours, theirs = (
            np.asarray(matrices(inputs[name], s - t, inputs["valid"]))[t] for name in ("features", "teacher")
        )
        for axis in (1,) if s == t else (1, 0):
            choices = inputs["valid"][s if axis == 1 else t].sum() - (s == t)
            rows = inputs["valid"][t if axis == 1 else s]
            apart += [(choices, d) for d in np.abs(ours - theirs).sum(axis)[rows]]
    choices, distances = np.array(apart).T
    assert distances.max() < 2
    edges = all_edges(jnp.asarray(inputs["valid"]), 1)
    wanted = edge_values(inputs["teacher"], edges, inputs["valid"])
    found = structure(inputs["features"], wanted, edges, None, inputs["valid"])
    np.testing.assert_allclose(found, np.average(distances, weights=choices), rtol=1e-9)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_features_equal_to_the_teachers_have_no_loss_and_teacher_and_graph_no_gradient():
    inputs = case(3)
    none = np.asarray(compiled(inputs["teacher"], inputs))[:3]
    np.testing.assert_allclose(none, 0, atol=1e-9)
    # Affinities are invariant to scale and shift.
    scaled = np.asarray(compiled(3 * inputs["teacher"] - 2, inputs))[1:3]
    np.testing.assert_allclose(scaled, 0, atol=1e-9)
    assert (np.asarray(compiled(inputs["features"], inputs)) > 1e-2).all()

    def of_teacher(positions, teacher):
        return compiled(inputs["features"], inputs | {"positions": positions, "teacher": teacher}).sum()

    for slope in jax.jit(jax.grad(of_teacher, (0, 1)))(inputs["positions"], inputs["teacher"]):
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("derivative", ["unrolled", "implicit"])
def test_slopes_are_those_of_central_differences_and_jvp_agrees_with_vjp(derivative):
    inputs, matching = case(4), Matching(iterations=60, derivative=derivative)
    along = np.random.default_rng(5).normal(size=(T, N, D))
    slopes = np.asarray(slopes_of(inputs["features"], inputs, matching))
    ahead, behind = (
        np.asarray(compiled(inputs["features"] + step * along, inputs, matching)) for step in (1e-6, -1e-6)
    )
    by_slope = (slopes * along).sum((1, 2, 3))
    np.testing.assert_allclose(by_slope, (ahead - behind) / 2e-6, rtol=1e-6)
    by_jvp = jax.jvp(lambda f: compiled(f, inputs, matching), (inputs["features"],), (along,))[1]
    np.testing.assert_allclose(by_jvp, by_slope, rtol=1e-9)
    assert (slopes[:, ~inputs["valid"]] == 0).all()
    assert (np.abs(slopes).max((1, 2, 3)) > 1e-3).all()


@pytest.mark.usefixtures("x64")
@given(SEEDS)
def test_another_order_of_nodes_changes_no_loss(seed):
    inputs = case(seed)
    order = np.random.default_rng(seed).permutation(N)
    other = {name: a[:, order] if a.ndim > 1 else a for name, a in inputs.items()}
    np.testing.assert_allclose(
        compiled(other["features"], other), compiled(inputs["features"], inputs), rtol=1e-8
    )


@pytest.mark.usefixtures("x64")
def test_twice_the_nodes_change_no_loss():
    inputs = case(6)
    twice = {name: np.concatenate([a, a], axis=1) if a.ndim > 1 else a for name, a in inputs.items()}

    @jax.jit
    def across(inputs):  # between frames only: within one, doubling gives each node a twin
        edges = all_edges(inputs["valid"], 1)
        wanted = edge_affinities(inputs["teacher"], edges, inputs["valid"])
        between = jnp.broadcast_to(np.array(edges.offsets) != 0, edges.valid.shape) * 1.0
        nodes = node_loss(inputs["features"], inputs["teacher"], inputs["valid"])
        return nodes, structure_loss(inputs["features"], wanted, edges, between, inputs["valid"])

    np.testing.assert_allclose(across(twice), across(inputs), rtol=1e-9)


# -- extremes ------------------------------------------------------------------------------------------------


def single(inputs):
    return {k: a if a.dtype == bool else np.float32(a) for k, a in inputs.items()}


def extreme(name: str):
    inputs = single(case(7))
    if name == "no features":
        inputs["features"] = inputs["teacher"] = np.zeros((T, N, D), np.float32)
    elif name == "features all alike":
        inputs["features"] = inputs["teacher"] = np.ones((T, N, D), np.float32)
    elif name == "one node":
        inputs["valid"] = np.zeros((T, N), bool)
        inputs["valid"][1, 2] = True
        inputs["teacher"] = inputs["features"]
    elif name == "no nodes":
        inputs["valid"] = np.zeros((T, N), bool)
    return inputs


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["no features", "features all alike", "one node", "no nodes"])
def test_in_degenerate_cases_losses_are_zero_with_zero_gradient(name):
    inputs = extreme(name)
    np.testing.assert_allclose(compiled(inputs["features"], inputs), 0, atol=1e-6)
    np.testing.assert_allclose(slopes_of(inputs["features"], inputs), 0, atol=1e-6)


@pytest.mark.thorough
def test_zero_features_learn_from_the_node_loss_and_the_rest_is_finite():
    inputs = extreme("")
    none = np.zeros((T, N, D), np.float32)
    found, slopes = (np.asarray(f(none, inputs)) for f in (compiled, slopes_of))
    assert found[0] > 1
    assert (np.abs(slopes[0]).max(2) > 0)[inputs["valid"]].all()
    assert np.isfinite(found).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_array_equal(found[3:], 0)


def test_nan_is_left_out_and_does_not_spread():
    inputs = extreme("")
    t, i = np.argwhere(inputs["valid"])[0]
    broken = inputs["features"].copy()
    broken[t, i] = np.nan
    found, slopes = (np.asarray(f(broken, inputs)) for f in (compiled, slopes_of))
    assert np.isfinite(found).all()
    assert np.isfinite(slopes).all()
    np.testing.assert_array_equal(slopes[:, t, i], 0)
    edges, weights, wanted, _ = graph(**inputs)
    ends_there = (np.arange(T)[:, None] + np.array(edges.offsets) == t)[:, None] & (edges.nodes == i)
    counted, absent = np.where(ends_there, np.float32(0), weights), inputs["valid"].copy()
    counted[t, i] = 0
    absent[t, i] = False
    one, other = (
        structure(features, wanted, edges, weight, valid)
        for features, weight, valid in (
            (broken, weights, inputs["valid"]),
            (inputs["features"], counted, absent),
        )
    )
    np.testing.assert_allclose(one, other, rtol=1e-5)
    teacher = inputs["teacher"].copy()
    teacher[t, i] = np.nan
    broken = inputs | {"teacher": teacher}
    without = inputs | {"valid": absent}
    np.testing.assert_allclose(
        *(np.asarray(compiled(t["features"], t))[[0, 3, 4]] for t in (broken, without)), rtol=1e-5
    )


# -- the rest ------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_a_batch_is_a_loop():
    many = [single(case(i)) for i in (1, 2)]
    stacked = jax.tree.map(lambda *a: np.stack(a), *many)
    together = jax.vmap(compiled)(stacked["features"], stacked)
    np.testing.assert_allclose(together, [compiled(one["features"], one) for one in many], rtol=1e-4)


def test_float32_is_near_to_float64():
    inputs = case(8)
    found = compiled(inputs["features"], inputs)
    with jax.enable_x64(True):
        double = compiled(inputs["features"], inputs)
    np.testing.assert_allclose(found, double, rtol=1e-4)


def test_mistakes_are_named():
    inputs = arrays(case(0))
    with pytest.raises(ValueError, match=r"window=0.*1 frame or more"):
        temporal_edges(inputs["teacher"], 2, 0)
