"""Features of a deforming scene: the losses of teacher and graph, and prompts."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.methods.deform import (
    DeformingScene,
    feature_loss,
    frame_graphs,
    graph_loss,
    nodes_of,
    prompt_probabilities,
    start_gaussians,
)
from gsjax.methods.deform.nodes import farthest_rows
from gsjax.scene.deformation import DeformationConfig, init_deformation
from gsjax.scene.initialize import gaussians_from_points
from tests.methods.deform.tissue import CODES, CONFIG, tissue

CODES32 = CODES.astype(np.float32)

of_pictures = jax.jit(feature_loss)
probabilities = jax.jit(prompt_probabilities)
of_graph = jax.jit(graph_loss, static_argnums=2)


@pytest.fixture(scope="module")
def frames():
    return tissue()[0]


@pytest.fixture(scope="module")
def ids():
    return tissue()[1].ids


class TestFeatureLoss:
    def test_is_of_the_teachers_grid(self):
        drawn = np.random.default_rng(0).uniform(size=(8, 12, 4)).astype(np.float32)
        ids = np.zeros((4, 6), np.int32)
        ids[1, 2] = -1
        # A triangle filter, two cells wide, around the centre of each cell along each axis.
        by_rows, by_columns = (
            np.maximum(0, 1 - np.abs((np.arange(2 * n) + 0.5) / 2 - (np.arange(n) + 0.5)[:, None]))
            for n in ids.shape
        )
        by_rows, by_columns = (one / one.sum(axis=1, keepdims=True) for one in (by_rows, by_columns))
        small = np.einsum("ir,jc,rcd->ijd", by_rows, by_columns, drawn)
        expected = np.abs(small - CODES[0]).mean(-1)[ids >= 0].mean()
        found = of_pictures(drawn, CODES32, ids)
        np.testing.assert_allclose(found, expected, rtol=1e-6)

    def test_a_teacher_of_the_same_size_is_not_resized(self):
        drawn = np.random.default_rng(1).uniform(size=(5, 7, 4)).astype(np.float32)
        found = of_pictures(drawn, CODES32, np.ones((5, 7), np.int32))
        np.testing.assert_allclose(found, np.abs(drawn - CODES[1]).mean(), rtol=1e-6)

    def test_every_pixel_learns_from_a_coarse_teacher(self):
        drawn, ids = np.full((24, 32, 4), 2.0, np.float32), np.zeros((3, 4), np.int32)
        slope = jax.jit(jax.grad(feature_loss))(drawn, CODES32, ids)
        assert (np.abs(slope) > 0).all()

    def test_without_labels_there_is_none(self):
        drawn = np.ones((4, 4, 4), np.float32)
        assert of_pictures(drawn, CODES32, np.full((4, 4), -1, np.int32)) == 0


@pytest.fixture(scope="module")
def graphs(frames, ids):
    gaussians = start_gaussians(frames[:1], 0, 1.0)
    nodes = farthest_rows(gaussians.means, CONFIG.graph.nodes)
    places = np.stack([np.asarray(gaussians.means)[nodes]] * len(frames))
    return nodes, {
        kind: frame_graphs(places, nodes, frames, ids, CODES, replace(CONFIG.graph, kind=kind), 0.05)
        for kind in ("matching", "similarity")
    }


class TestGraph:
    def test_nodes_that_a_tool_hides_are_absent(self, graphs, frames, ids):
        nodes, found = graphs
        there = np.asarray(found["matching"][0].valid)
        assert there.any()
        covered = [replace(frame, masks=np.zeros_like(frame.masks)) for frame in frames]
        places = np.zeros((len(frames), len(nodes), 3))
        none = frame_graphs(places, nodes, covered, ids, CODES, CONFIG.graph, 0.05)
        assert not np.asarray(none[0].valid).any()
        features = np.ones((nodes.max() + 1, 4), np.float32)
        assert all(value == 0 for value in of_graph(features, none[0], CONFIG.graph).values())

    def test_the_teachers_own_features_cost_nothing(self, graphs):
        """With one class in view and its code as the feature of all nodes, no node or pair has a loss."""
        nodes, found = graphs
        features = np.tile(CODES32[0], (nodes.max() + 1, 1))
        for kind, names in (("matching", ("node", "structure")), ("similarity", ("spatial", "temporal"))):
            values = of_graph(features, found[kind][0], replace(CONFIG.graph, kind=kind))
            np.testing.assert_allclose([values[name] for name in names], 0, atol=1e-5)
        apart = np.random.default_rng(0).normal(size=features.shape).astype(np.float32)
        for kind in found:
            values = of_graph(apart, found[kind][0], replace(CONFIG.graph, kind=kind))
            assert sum(values.values()) > 0.01

    def test_gradients_reach_only_nodes(self, graphs):
        nodes, found = graphs
        features = np.random.default_rng(0).normal(size=(nodes.max() + 5, 4)).astype(np.float32)
        slope = jax.jit(jax.grad(lambda f: sum(graph_loss(f, found["matching"][2], CONFIG.graph).values())))(
            features
        )
        assert np.isfinite(slope).all()
        others = np.setdiff1d(np.arange(len(features)), nodes)
        assert (np.asarray(slope)[others] == 0).all()
        assert (np.asarray(slope)[nodes] != 0).any()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["all", "rows", "nodes"])
@pytest.mark.parametrize("changes", [True, False])
def test_features_of_some_at_times_are_those_of_the_scene_there(kind, changes):
    points = np.random.default_rng(0).uniform(0, 1, (20, 3)).astype(np.float32)
    values = jax.random.normal(jax.random.key(1), (20, 3))
    gaussians = gaussians_from_points(points, points)
    gaussians = eqx.tree_at(lambda g: g.features, gaussians, values, is_leaf=lambda leaf: leaf is None)
    config = DeformationConfig(
        resolution=4, time_resolution=3, levels=1, channels=2, hidden=5, feature=changes
    )

    @jax.jit
    def noisy():
        field = init_deformation(jax.random.key(2), config, np.array([[0, 0, 0], [1, 1, 1]]), 3)
        return jax.tree.map(lambda leaf: leaf + 0.1 * jax.random.normal(jax.random.key(3), leaf.shape), field)

    scene = DeformingScene(gaussians, noisy())
    moving = {"all": None, "rows": np.array([1, 4, 7, 20]), "nodes": nodes_of(gaussians, 6)}[kind]
    times, some = np.array([0.0, 0.3, 1.0], np.float32), np.array([4, 0, 9])
    found = jax.jit(DeformingScene.features_at)(scene, times, some, moving)
    at = jax.jit(DeformingScene.at)
    wanted = np.stack([np.asarray(at(scene, time, moving).features)[some] for time in times])
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (np.ptp(found, axis=0).max() > 1e-3) == changes


@pytest.mark.usefixtures("x64")
class TestPrompts:
    def test_are_a_softmax_of_cosines(self):
        rng = np.random.default_rng(0)
        features, prompts = rng.normal(size=(7, 4)), rng.normal(size=(3, 4))
        cosines = (features @ prompts.T) / np.outer(
            np.linalg.norm(features, axis=1), np.linalg.norm(prompts, axis=1)
        )
        expected = np.exp(cosines / 0.1) / np.exp(cosines / 0.1).sum(axis=1, keepdims=True)
        found = probabilities(features, prompts)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        longer = probabilities(1e3 * features, 1e-3 * prompts)
        np.testing.assert_allclose(longer, expected, atol=1e-12)

    def test_a_feature_of_length_0_makes_all_equally_likely(self):
        features = np.array([[0.0, 0, 0, 0], [1, 0, 0, 0]])
        found = probabilities(features, CODES)
        np.testing.assert_allclose(found[0], 0.5)
        assert found[1, 0] > 0.99
        slope = jax.jit(jax.grad(lambda f: prompt_probabilities(f, jnp.asarray(CODES))[:, 0].sum()))(features)
        assert np.isfinite(slope).all()
