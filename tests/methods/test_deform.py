"""A deforming scene: where it starts, that it learns, and that it goes on to the same bits."""

from dataclasses import replace
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.io.checkpoints import load_checkpoint, save_checkpoint
from gsjax.methods.deform import (
    PRESETS,
    DeformingScene,
    begin_deform,
    compiled_step,
    nodes_of,
    of_step,
    prompt_probabilities,
    reconstruct,
    start_gaussians,
)
from gsjax.methods.deform.start import known_depth
from gsjax.metrics.image import psnr
from gsjax.scene.render import render
from tests.methods.tissue import CODES, CONFIG, tissue_looks


@pytest.fixture(scope="module")
def looks():
    return tissue_looks()


def sight(problem, state, i):
    """What the scene looks like where look `i` was."""
    batch = problem.batches[i]
    drawn = render(state.scene.at(batch.time, state.moving), batch.camera, problem.plan_for(state))
    look = problem.looks[i]
    return psnr(np.clip(np.asarray(drawn.colors[0], float), 0, 1), look.image / 255, look.counts)


class TestStart:
    def test_gaussians_lie_where_the_first_look_sees_something(self, looks):
        gaussians = start_gaussians(looks[:1], 0, 1.0)
        look = looks[0]
        local = np.asarray(gaussians.means) @ look.viewmat[:3, :3].T + look.viewmat[:3, 3]
        x, y = ((local @ look.K.T)[:, :2] / local[:, 2:]).T.astype(int)
        np.testing.assert_allclose(known_depth(look)[y, x], local[:, 2], rtol=0.02)

    def test_later_looks_add_what_a_tool_hid_and_nothing_else(self, looks):
        hidden = np.zeros_like(looks[0].counts)
        hidden[20:32, 20:44] = True
        first = looks[0]._replace(counts=looks[0].counts & ~hidden)
        alone, all_ = (start_gaussians([first, *more], 0, 1.0) for more in ([], looks[1:]))
        new = np.asarray(all_.means)[alone.num :]
        local = new @ first.viewmat[:3, :3].T + first.viewmat[:3, 3]
        x, y = ((local @ first.K.T)[:, :2] / local[:, 2:]).T.astype(int)
        inside = (x >= 0) & (x < 64) & (y >= 0) & (y < 52)
        assert hidden[y[inside], x[inside]].sum() > 60
        assert not (known_depth(first)[y[inside], x[inside]] > 0).any()

    def test_later_looks_add_what_lies_far_behind_something(self, looks):
        """A plate a third nearer hides tissue in the first look, and is gone in the others."""
        plate = np.s_[20:32, 20:44]
        first = looks[0]._replace(counts=None, depth=looks[0].depth.copy())
        first.depth[plate] *= 2 / 3
        alone, all_ = (start_gaussians([first, *more], 0, 1.0) for more in ([], looks[1:]))
        new = np.asarray(all_.means)[alone.num :]
        local = new @ first.viewmat[:3, :3].T + first.viewmat[:3, 3]
        x, y = ((local @ first.K.T)[:, :2] / local[:, 2:]).T.astype(int)
        behind = (x >= 20) & (x < 44) & (y >= 20) & (y < 32)
        assert behind.sum() > 60
        np.testing.assert_allclose(local[behind, 2], looks[0].depth[y, x][behind], rtol=0.1)

    def test_without_depth_there_is_no_start(self, looks):
        flat = [look._replace(depth=np.zeros_like(look.depth)) for look in looks]
        with pytest.raises(ValueError, match="depth: no look has any where a pixel counts"):
            start_gaussians(flat, 0, 1.0)
        with pytest.raises(ValueError, match="masks: in no look does any pixel count; are they inverted"):
            begin_deform([look._replace(counts=np.zeros_like(look.counts)) for look in looks], CONFIG)
        with pytest.raises(ValueError, match="looks: expected pictures"):
            begin_deform([looks[0], looks[1]._replace(image=looks[1].image[:-2])], CONFIG)
        with pytest.raises(ValueError, match="codebook: expected rows of 4 numbers, found 3"):
            begin_deform(looks, CONFIG, np.eye(2, 3))
        with pytest.raises(ValueError, match="expected ids of 1 rows of the codebook, or -1, found 1 in"):
            begin_deform(looks, CONFIG, CODES[:1])
        with pytest.raises(ValueError, match="found none in 1"):
            begin_deform([looks[0], looks[1]._replace(ids=None)], CONFIG, CODES)
        with pytest.raises(ValueError, match="looks: expected depth of"):
            begin_deform([looks[0], looks[1]._replace(depth=looks[1].depth[:-2])], CONFIG)
        lone = np.zeros_like(looks[0].depth)
        lone[20, 20] = 0.1
        with pytest.raises(ValueError, match="depth: expected a scene of some extent"):
            begin_deform([looks[0]._replace(depth=lone)], CONFIG)

    def test_a_first_frame_that_is_all_tool_is_not_begun_with(self, looks):
        hidden = looks[0]._replace(counts=np.zeros_like(looks[0].counts))
        problem, _ = begin_deform([hidden, *looks[1:]], CONFIG)
        assert problem.first == 1


def test_nodes_blend_to_one_and_follow_what_is_near(looks):
    gaussians = start_gaussians(looks[:1], 0, 1.0)
    nodes = nodes_of(gaussians, 40)
    np.testing.assert_allclose(nodes.weights.sum(axis=1), 1.0, atol=1e-5)
    assert (nodes.weights > 0).all()
    # A map that is linear in the place is blended to nearly itself.
    blended_places = (gaussians.means[nodes.rows][nodes.indices] * nodes.weights[..., None]).sum(axis=1)
    spread = np.asarray(gaussians.means).std()
    assert np.abs(blended_places - gaussians.means).max() < 0.5 * spread
    assert len(nodes_of(gaussians, 10 * gaussians.num).rows) == gaussians.num


def test_a_scene_without_a_field_stands_still(looks):
    scene = DeformingScene(start_gaussians(looks[:1], 0, 2.0))
    assert scene.at(jnp.asarray(0.7)) is scene.gaussians


@pytest.fixture(scope="module")
def learned(looks):
    problem, state = begin_deform(looks, CONFIG, CODES)
    first = [sight(problem, state, i) for i in range(len(looks))]
    infos = []
    for found in reconstruct(problem, state):
        state = found.state
        infos.append(jax.device_get(found.info))
    return problem, state, first, infos


class TestLearning:
    def test_all_frames_get_better(self, learned):
        problem, state, first, infos = learned
        now = [sight(problem, state, i) for i in range(len(first))]
        assert not any(info["skipped"] for info in infos)
        assert np.mean(now) > np.mean(first) + 1.5
        assert min(now) > min(first) + 1
        # The deformation has its share: the last frame is not the first.
        last = len(first) - 1
        still = problem.batches[last]._replace(time=problem.batches[0].time)
        frozen = problem._replace(batches=[still] * len(first))
        assert now[last] > sight(frozen, state, last) + 0.3

    def test_gaussians_mean_what_the_teacher_says(self, learned):
        *_, infos = learned
        assert {"node", "structure"} <= set(infos[-1])
        assert infos[-1]["feature"] < 0.6 * infos[0]["feature"]

    def test_a_step_compiles_once_for_each_kind(self, learned):
        problem, *_ = learned
        # The warm-up, the deformation without a graph, and with it.
        assert compiled_step(problem.config, problem.radius)._cache_size() <= 3

    @pytest.mark.slow
    def test_goes_on_to_the_same_bits(self, learned, looks, tmp_path):
        problem, whole, *_ = learned
        _, state = begin_deform(looks, CONFIG, CODES)
        for found in reconstruct(problem, state):
            if found.state.step == 50:  # after the graphs were made
                save_checkpoint(tmp_path / "state.npz", jax.device_get(found.state))
                break
        _, first = begin_deform(looks, CONFIG, CODES)
        state, _ = load_checkpoint(tmp_path / "state.npz", of_step(problem, first, 50))
        for found in reconstruct(problem, state):
            state = found.state
        for one, other in zip(jax.tree.leaves(whole.scene), jax.tree.leaves(state.scene), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_depth_that_is_no_number_is_unknown(self, looks):
        depth = looks[0].depth.copy()
        depth[10, 10], depth[11, 11] = np.nan, np.inf
        told = replace(CONFIG, warmup=1, iterations=0)
        problem, state = begin_deform([looks[0]._replace(depth=depth)], told)
        info = jax.device_get(next(reconstruct(problem, state)).info)
        assert np.isfinite(info["loss"])
        assert not info["skipped"]

    def test_a_teacher_without_numbers_changes_nothing(self, learned):
        problem, state, *_ = learned
        scene, optimizer = jax.tree.map(jnp.copy, (state.scene, state.optimizer))
        before = jax.device_get(scene)
        batch = problem.batches[0]._replace(
            codebook=problem.batches[0].codebook.at[0, 0].set(jnp.nan),
            moving=state.moving,
            graph=state.graphs[0],
            plan=problem.plan_for(state),
        )
        advance = compiled_step(CONFIG, problem.radius)
        after, _, info = advance(scene, optimizer, batch, jnp.asarray(70), jax.random.key(0))
        assert info["skipped"]
        for one, other in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_rates_fall_over_both_parts_of_the_learning(self, looks):
        """The optimizer begins anew with the deformation, and its rates do not."""
        told = replace(CONFIG, warmup=3, iterations=3, schedule="cosine", warmup_frames="all")
        problem, state = begin_deform(looks, told)
        means = [np.array(state.scene.gaussians.means)]
        for found in reconstruct(problem, state):
            means.append(np.array(found.state.scene.gaussians.means))
        steps = [np.abs(b - a).max() for a, b in pairwise(means)]
        # Adam's first step is as long as the rate: of the third step after the warm-up, half of the first.
        fall = 0.5 * (1 + np.cos(np.pi * 3 / 6))
        np.testing.assert_allclose(steps[3] / steps[0], fall, rtol=0.02)

    @pytest.mark.slow
    def test_those_that_moved_farthest_go_on_deforming(self, looks, tmp_path):
        told = replace(CONFIG, nodes=0, warmup=2, iterations=12, moving_share=0.25)
        problem, first = begin_deform(looks, told)
        gate = 2 + 3
        for found in reconstruct(problem, first):
            state = found.state
            if state.step == gate:
                before = jax.tree.map(jnp.copy, state.scene)
            if state.step == 9:
                save_checkpoint(tmp_path / "state.npz", jax.device_get(state))
        rows, count = np.asarray(state.moving), before.gaussians.num
        assert len(rows) == round(count / 4)
        then = np.stack([before.at(batch.time).means for batch in problem.batches])
        far = np.linalg.norm(then - before.gaussians.means, axis=-1).max(axis=0)
        assert far[rows].min() >= np.delete(far, rows).max()
        at = state.scene.at(jnp.asarray(0.7), state.moving).means
        still = np.delete(np.arange(count), rows)
        np.testing.assert_array_equal(at[still], state.scene.gaussians.means[still])
        assert np.abs(np.asarray(at - state.scene.gaussians.means))[rows].max() > 0
        # What was saved goes on to the same bits.
        _, again = begin_deform(looks, told)
        again, _ = load_checkpoint(tmp_path / "state.npz", of_step(problem, again, 9))
        for found in reconstruct(problem, again):
            again = found.state
        for one, other in zip(jax.tree.leaves(state.scene), jax.tree.leaves(again.scene), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_what_cannot_be_drawn_is_left_out(self, looks):
        given = start_gaussians(looks[:1], 0, 2.0)
        spoilt = eqx.tree_at(lambda g: g.means, given, given.means.at[:3].set(jnp.nan))
        _, state = begin_deform(looks, CONFIG, gaussians=spoilt)
        assert state.scene.gaussians.num == given.num - 3
        nowhere = eqx.tree_at(lambda g: g.means, given, given.means * jnp.nan)
        with pytest.raises(ValueError, match="gaussians: expected some"):
            begin_deform(looks, CONFIG, gaussians=nowhere)

    def test_what_was_given_is_kept(self, looks):
        given = start_gaussians(looks[:1], 0, 2.0)
        problem, state = begin_deform(looks, replace(CONFIG, warmup=1, iterations=0), gaussians=given)
        next(reconstruct(problem, state))
        assert not given.means.is_deleted()


def test_a_learned_scene_is_asked_what_it_was_taught(learned):
    """One class in view of the tools that are left out: what it was taught is what it answers."""
    _, state, *_ = learned
    found = prompt_probabilities(state.scene.gaussians.features, jnp.asarray(CODES, jnp.float32))
    assert (found[:, 0] > 0.9).mean() > 0.8


@pytest.mark.parametrize("smaller", [1, 2])
def test_what_does_not_count_is_not_taught(looks, smaller):
    """Else what lies behind a tool would learn that it is one."""
    counts = np.ones_like(looks[0].counts)
    counts[10:20, 30:44] = False
    ids = np.ones(counts.shape, np.int32)[::smaller, ::smaller]
    problem, _ = begin_deform([looks[0]._replace(counts=counts, ids=ids)], CONFIG, CODES)
    np.testing.assert_array_equal(problem.batches[0].ids == 1, counts[::smaller, ::smaller])
    np.testing.assert_array_equal(problem.batches[0].ids == -1, ~counts[::smaller, ::smaller])


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_learn(name, looks):
    config = replace(
        PRESETS[name], warmup=0, iterations=6, start_pixels=2.0, nodes=0, channels=4, warmup_frames="all"
    )
    config = replace(config, deformation=replace(config.deformation, resolution=8, levels=1, channels=2))
    config = replace(config, graph=replace(config.graph, after=0, nodes=12, neighbors=2, matches=2, window=1))
    problem, state = begin_deform(looks, config, CODES)
    infos = [jax.device_get(found.info) for found in reconstruct(problem, state)]
    assert not any(info["skipped"] for info in infos)
    assert infos[-1]["rgb"] < infos[0]["rgb"]
    assert ({"spatial", "temporal"} if name == "clin" else {"node", "structure"}) <= set(infos[-1])
