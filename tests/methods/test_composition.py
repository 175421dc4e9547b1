"""Methods composed in one jitted step, as in docs/composition.md: tracker, feature distillation and graph;
and a fit together with a deforming scene."""

import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jaxtyping import Array, Int

from gsjax.geometry.cameras import unproject
from gsjax.methods import deform, fit
from gsjax.methods.deform import Deform, GraphConfig, batch_of, graph_of, nodes_of, seen_ids
from gsjax.methods.fit import Fit
from gsjax.methods.track import (
    PLAN,
    PRESETS,
    AlignConfig,
    FrameShape,
    GrowConfig,
    Track,
    TrackBatch,
    first_pose,
    place,
)
from gsjax.optim.method import Run
from gsjax.scene.deformation import Nodes
from gsjax.scene.render import plan_render
from tests.docs.blocks import programs
from tests.engine.cases import FIT
from tests.methods.deform.tissue import CONFIG, tissue

ROOT = Path(__file__).resolve().parents[2]
CODES = jnp.asarray(np.eye(7, 8), jnp.float32)
RADIUS = 0.5


@cache
def page_names(function: str = "composed") -> dict:
    """The names defined by the page's program that contains a function."""
    (block,) = (one for one in programs("docs/composition.md") if f"\ndef {function}(" in one.text)
    names: dict = {}
    exec(compile(block.text, block.place, "exec"), names)
    return names


class Small(NamedTuple):
    config: Any
    shape: FrameShape
    run: Run
    batches: list[TrackBatch]
    ids: Int[Array, "t c h w"]
    nodes: Nodes


@pytest.fixture(scope="module")
def small(table, started):
    """Three frames of a table, a tracker that searches only at the last known poses, and nodes."""
    sequence, frames, _ = table()
    align = AlignConfig(iterations=2, reach=0.0, turns=(), pixels=32, centers=32)
    config = replace(PRESETS["fast"], align=align, grow=GrowConfig(slots=0))
    shape, run = Track(config).start(started, frames[0])
    batches = [TrackBatch(frame, run.plans[PLAN]) for frame in frames[:3]]
    ids = np.stack([[sequence.mask(t, c) for c in (0, 1)] for t in range(3)])
    nodes = nodes_of(started.gaussians, 8, np.asarray(started.labels))
    return Small(config, shape, run, batches, jnp.asarray(ids, jnp.int32), nodes)


@pytest.fixture(scope="module")
def composed(small):
    """composed(kind of graph) -> the page's loss, init and step, and the tracker that they use."""
    page = page_names()
    scene, cameras = small.run.params.scene, small.batches[0].frame.cameras
    plan = plan_render(scene.gaussians, cameras, headroom=2.0)
    tracker = Track(small.config).step(small.shape)

    def make(kind):
        how = (RADIUS, optax.adam(0.1), graph_config(kind), plan)
        return *page["composed"](tracker, small.nodes, CODES, *how), tracker

    return make


def graph_config(kind: str) -> GraphConfig:
    return GraphConfig(kind=kind, neighbors=3, matches=2, window=1)


class TestOneStep:
    @pytest.mark.slow
    def test_a_gradient_reaches_features_and_poses(self, small, composed):
        loss, *_ = composed("none")
        batch, scene = small.batches[1], small.run.params.scene

        def of(features, pose):
            given = place(scene, pose), batch.frame.cameras, small.ids[1], None
            return loss(features, given, step=0, key=None)[0]

        features = 0.1 * jax.random.normal(jax.random.key(0), (len(small.nodes.rows), 8))
        to_features, to_pose = jax.jit(jax.grad(of, argnums=(0, 1)))(features, first_pose(scene))
        assert (jnp.abs(to_features).sum(axis=1) > 0).mean() > 0.5
        assert jnp.isfinite(to_pose.means).all()
        assert (jnp.abs(to_pose.means).sum(axis=1) > 0).mean() > 0.5

    @pytest.mark.slow
    @pytest.mark.parametrize("kind", ["matching", "similarity"])
    def test_it_is_the_separate_steps_one_after_the_other(self, small, composed, kind):
        loss, init, step, tracker = composed(kind)
        features, nodes = jnp.zeros((len(small.nodes.rows), 8)), small.nodes.rows
        tracked, tracking = small.run.params, small.run.state
        memory = page_names()["empty_memory"](3, len(nodes))
        state = tracked, tracking, features, init(features), memory
        step, tracks = jax.jit(step), jax.jit(partial(tracker.update, step=0))
        for t in (0, 1, 2):
            batch, key = small.batches[t], jax.random.key(t)
            before = state
            state, info = step(state, batch, batch.frame.cameras, small.ids[t], jnp.float32(t), key)
            assert not info["skipped"]
            assert not info["overflow"].any()
            tracked, tracking, followed = tracks(tracked, tracking, batch, key=key)
            np.testing.assert_allclose(state[0].pose.means, tracked.pose.means, atol=1e-5)
            np.testing.assert_allclose(info["tracker"], followed["residual"], rtol=1e-3, atol=1e-5)
        assert step._cache_size() == 1
        # The last step of the features by hand, on the graph of what its memory holds.
        memory, config = state[4], graph_config(kind)
        np.testing.assert_array_equal(memory.ids[:2], before[4].ids[1:])
        taught = CODES[jnp.maximum(memory.ids, 0)]
        graph = graph_of(config, RADIUS, nodes, *memory[:2], taught, memory.ids >= 0)
        given = state[0].gaussians(), batch.frame.cameras, small.ids[2], graph
        value, terms = loss(before[2], given, step=0, key=None)
        np.testing.assert_allclose(info["loss"], value, rtol=1e-4)
        assert set(terms) - {"overflow"} <= set(info)


ids_seen = jax.jit(seen_ids)


class TestSeenIds:
    @pytest.mark.thorough
    def test_they_are_those_of_the_pixels_that_show_a_place(self, small, table):
        sequence, _, _ = table()
        batch = small.batches[0]
        frame, ids = jax.device_get((batch.frame, small.ids[0]))
        # Points from camera 1's own depth: it sees them all, so their ids are those of its mask.
        rows, columns = np.nonzero(frame.depths[1] > 0)
        places = _unprojected(frame, 1, rows, columns)
        alone = jax.tree.map(lambda a: a[1:], frame.cameras)
        found = ids_seen(places, alone, ids[1:], frame.depths[1:])
        np.testing.assert_array_equal(found, sequence.mask(0, 1)[rows, columns])
        # On a teacher's grid of half the size, the id is that of the cell at the same relative position.
        half = ids_seen(places, alone, ids[1:, ::2, ::2], frame.depths[1:])
        np.testing.assert_array_equal(half, ids[1, ::2, ::2][rows // 2, columns // 2])

    @pytest.mark.thorough
    def test_what_is_hidden_or_outside_has_none_and_the_next_camera_is_asked(self, small):
        frame, ids = jax.device_get((small.batches[0].frame, small.ids[0]))
        rows, columns = (np.array([40, 41]), np.array([40, 50]))
        places = _unprojected(frame, 1, rows, columns)
        nearer = frame.depths * np.array([1, 0.5], np.float32)[:, None, None]
        alone = jax.tree.map(lambda a: a[1:], frame.cameras)
        assert (np.asarray(ids_seen(places, alone, ids[1:], nearer[1:])) == -1).all()
        assert (np.asarray(ids_seen(places + np.float32(100), frame.cameras, ids, frame.depths)) == -1).all()
        both = jax.tree.map(lambda a: a[::-1], frame.cameras)
        turned = ids_seen(places, both, ids[::-1], nearer[::-1])
        first = jax.tree.map(lambda a: a[:1], frame.cameras)
        np.testing.assert_array_equal(turned, ids_seen(places, first, ids[:1], frame.depths[:1]))


def _unprojected(frame, c, rows, columns):
    pixels = np.float32(np.stack([columns, rows], axis=1) + 0.5)
    depths = frame.depths[c][rows, columns]
    return np.asarray(jax.jit(unproject)(pixels, depths, frame.cameras.viewmat[c], frame.cameras.K[c]))


def test_nodes_of_groups_are_blended_within_their_groups(small, started):
    groups = np.asarray(started.labels)
    nodes = small.nodes
    of_nodes = groups[np.asarray(nodes.rows)]
    weights, indices = np.asarray(nodes.weights), np.asarray(nodes.indices)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-5)
    assert (of_nodes[indices] == groups[:, None])[weights > 0].all()
    assert (np.bincount(of_nodes) <= 8).all()
    # A single group gives the same nodes as no groups.
    alone = nodes_of(started.gaussians, 8, np.zeros_like(groups))
    plain = nodes_of(started.gaussians, 8)
    np.testing.assert_array_equal(alone.rows, plain.rows)
    np.testing.assert_array_equal(alone.weights, plain.weights)


def test_the_page_has_what_the_experiment_runs():
    """`composed` is the same in both, letter for letter, but for docstrings."""
    page, experiment = (
        (ROOT / path)
        .read_text(encoding="utf-8")
        .split("\ndef composed")[1]
        .split("    return loss, learner.init")[0]
        for path in ("docs/composition.md", "experiments/composition/one_step.py")
    )
    assert page == re.sub(r'    """.*?"""\n\n', "", experiment, flags=re.DOTALL)


class Joined(NamedTuple):
    """The page's step for a fit and a deforming scene, its params, and `batch(i)` for step i."""

    step: Any
    configs: tuple[Any, Any]
    params: Any
    batch: Any


@pytest.fixture(scope="module")
def joined():
    """Breathing tissue for the deforming scene, and the tools in front of it, static to the fit."""
    page, (frames, _) = page_names("together"), tissue()
    still = Fit(replace(FIT, steps=20, coarse_until=0.0, sh_degree=0))
    moving = Deform(replace(CONFIG, warmup=0, iterations=20, graph=GraphConfig(kind="none")))
    background, first = still.start([replace(frame, masks=~frame.masks) for frame in frames])
    motion, second = moving.start(frames)
    first, second = still.between(background, first, 0.0), moving.between(motion, second, 0.0)

    def batch(i):
        seen, _ = still.batch(background, first.having(step=i), 0.0)
        return page["Both"](seen, batch_of(motion, second, int(seen.view)))

    configs = still.config, moving.config
    return Joined(page["together"](*configs), configs, page["Both"](first.params, second.params), batch)


@pytest.fixture(scope="module")
def update_joined(joined):
    return jax.jit(joined.step.update)


class TestStillAndMoving:
    @pytest.mark.thorough
    def test_each_part_is_updated_as_by_its_step_alone(self, joined, update_joined):
        page = page_names("together")
        still, moving = (
            fit.step(joined.configs[0]),
            deform.step(joined.configs[1], (page["nothing_outside"],)),
        )
        batch, key, params = joined.batch(0), jax.random.key(3), joined.params
        together, state, info = update_joined(params, joined.step.init(params), batch, step=0, key=key)
        for name, step in (("still", still), ("moving", moving)):
            part, given = getattr(params, name), getattr(batch, name)
            alone, alone_state, reported = jax.jit(step.update)(part, step.init(part), given, step=0, key=key)
            found = getattr(together, name), getattr(state, name)
            for a, b in zip(jax.tree.leaves(found), jax.tree.leaves((alone, alone_state)), strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)
            np.testing.assert_allclose(getattr(info["losses"], name), reported["loss"], rtol=1e-5)
        np.testing.assert_allclose(info["loss"], sum(info["losses"]), rtol=1e-6)

    @pytest.mark.thorough
    def test_both_losses_go_down_in_one_compiled_program(self, joined, update_joined):
        params, losses = joined.params, []
        state = joined.step.init(params)
        for i in range(16):
            given = joined.batch(i % 2)
            params, state, info = update_joined(params, state, given, step=i, key=jax.random.key(i))
            assert not info["skipped"]
            losses.append([float(loss) for loss in info["losses"]])
        assert np.isfinite(losses).all()
        assert (np.mean(losses[-2:], axis=0) < np.mean(losses[:2], axis=0)).all()
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))
        assert update_joined._cache_size() == 1

    @pytest.mark.thorough
    def test_where_one_overflows_neither_is_updated(self, joined):
        params, batch = joined.params, joined.batch(0)
        tight = batch.moving._replace(plan=replace(batch.moving.plan, capacity=16))
        state, update = joined.step.init(params), jax.jit(joined.step.update)
        after = update(params, state, batch._replace(moving=tight), step=0, key=jax.random.key(0))
        assert after[2]["skipped"]
        assert after[2]["overflow"]
        for a, b in zip(jax.tree.leaves(after[:2]), jax.tree.leaves((params, state)), strict=True):
            np.testing.assert_array_equal(a, b)
