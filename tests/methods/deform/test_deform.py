"""A deforming scene: its initialization, training and features."""

from dataclasses import replace
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.engine.drive import drive
from gsjax.io.checkpoints import load_checkpoint, save_checkpoint
from gsjax.methods.deform import (
    PRESETS,
    Deform,
    DeformingScene,
    DeformWeightsConfig,
    Lesson,
    can_start_from,
    nodes_of,
    prompt_probabilities,
    start_gaussians,
)
from gsjax.methods.deform.method import PLAN
from gsjax.methods.deform.start import known_depth
from gsjax.metrics.image import psnr
from gsjax.scene.render import render
from tests.methods.deform.tissue import CODES, CONFIG, tissue


@pytest.fixture(scope="module")
def frames():
    return tissue()[0]


@pytest.fixture(scope="module")
def lesson():
    return tissue()[1]


scene_at = jax.jit(DeformingScene.at)


def sight(problem, run, i, time=None):
    """PSNR of the scene rendered by the camera of frame `i`, at its time or at another."""
    seen = problem.seen[i]
    there = scene_at(run.params, seen.time if time is None else time, run.kept.moving)
    drawn = render(there, seen.cameras, run.plans[PLAN])
    frame = problem.frames[i]
    return psnr(np.clip(np.asarray(drawn.colors[0], float), 0, 1), frame.images[0] / 255, frame.masks[0])


def seen_in(frame, points):
    """Columns, rows and depths of points in a frame of one camera."""
    viewmat, K = frame.cameras.viewmat[0], frame.cameras.K[0]
    local = np.asarray(points) @ viewmat[:3, :3].T + viewmat[:3, 3]
    x, y = ((local @ K.T)[:, :2] / local[:, 2:]).T.astype(int)
    return x, y, local[:, 2]


class TestStart:
    def test_gaussians_lie_on_the_surface_of_the_first_frame(self, frames):
        gaussians = start_gaussians(frames[:1], 0, 1.0)
        x, y, depth = seen_in(frames[0], gaussians.means)
        np.testing.assert_allclose(known_depth(frames[0])[y, x], depth, rtol=0.02)

    def test_later_frames_add_what_a_tool_hid_and_nothing_else(self, frames):
        hidden = np.zeros_like(frames[0].masks[0])
        hidden[20:32, 20:44] = True
        first = replace(frames[0], masks=frames[0].masks & ~hidden)
        alone, all_ = (start_gaussians([first, *more], 0, 1.0) for more in ([], frames[1:]))
        x, y, _ = seen_in(first, all_.means[alone.num :])
        inside = (x >= 0) & (x < 64) & (y >= 0) & (y < 52)
        assert hidden[y[inside], x[inside]].sum() > 60
        assert not (known_depth(first)[y[inside], x[inside]] > 0).any()

    def test_later_frames_add_what_lies_far_behind_something(self, frames):
        """A plate, a third nearer, hides tissue in the first frame and is absent from the others."""
        first = replace(frames[0], masks=None, depths=frames[0].depths.copy())
        first.depths[0, 20:32, 20:44] *= 2 / 3
        alone, all_ = (start_gaussians([first, *more], 0, 1.0) for more in ([], frames[1:]))
        x, y, depth = seen_in(first, all_.means[alone.num :])
        behind = (x >= 20) & (x < 44) & (y >= 20) & (y < 32)
        assert behind.sum() > 60
        np.testing.assert_allclose(depth[behind], frames[0].depths[0, y, x][behind], rtol=0.1)

    def test_without_depth_there_is_no_start(self, frames, lesson):
        method = Deform(CONFIG)
        flat = [replace(frame, depths=np.zeros_like(frame.depths)) for frame in frames]
        with pytest.raises(ValueError, match="depth: no frame has any where a pixel counts"):
            start_gaussians(flat, 0, 1.0)
        with pytest.raises(ValueError, match="masks: expected pixels that count, found none in any frame"):
            method.start([replace(frame, masks=np.zeros_like(frame.masks)) for frame in frames])
        with pytest.raises(ValueError, match="frames: expected one image"):
            method.start([frames[0], eqx.tree_at(lambda f: f.images, frames[1], frames[1].images[:, :-2])])
        with pytest.raises(ValueError, match="codebook: expected rows of 4 numbers, found 3"):
            method.start(frames, lesson._replace(codebook=np.eye(2, 3)))
        with pytest.raises(ValueError, match=r"expected ids below 1, the number of rows .*, found 1 in"):
            method.start(frames, lesson._replace(codebook=CODES[:1]))
        with pytest.raises(ValueError, match="lesson: expected ids of 2 frames, found 5"):
            method.start(frames[:2], lesson)
        with pytest.raises(ValueError, match="frames: expected depths"):
            method.start([frames[0], eqx.tree_at(lambda f: f.depths, frames[1], frames[1].depths[:, :-2])])
        lone = np.zeros_like(frames[0].depths)
        lone[0, 20, 20] = 0.1
        with pytest.raises(ValueError, match="depth: expected a scene of some extent"):
            method.start([replace(frames[0], depths=lone)])

    def test_it_does_not_start_from_a_frame_that_is_all_tool(self, frames):
        hidden = replace(frames[0], masks=np.zeros_like(frames[0].masks))
        assert not can_start_from(hidden, frames)
        problem, _ = Deform(CONFIG).start([hidden, *frames[1:]])
        assert problem.first == 1


def test_a_weight_of_dssim_above_one_is_refused():
    """Regression test: it pushed colours away from the pictures."""
    with pytest.raises(ValueError, match=r"weights.dssim: expected at least 0 and at most 1, found 2"):
        DeformWeightsConfig(dssim=2)


def test_nodes_blend_to_one_and_follow_what_is_near(frames):
    gaussians = start_gaussians(frames[:1], 0, 1.0)
    nodes, means = jax.device_get((nodes_of(gaussians, 40), gaussians.means))
    np.testing.assert_allclose(nodes.weights.sum(axis=1), 1.0, atol=1e-5)
    assert (nodes.weights > 0).all()
    # Blending nearly reproduces a function that is linear in the position.
    blended_places = (means[nodes.rows][nodes.indices] * nodes.weights[..., None]).sum(axis=1)
    assert np.abs(blended_places - means).max() < 0.5 * means.std()
    assert len(nodes_of(gaussians, 10 * gaussians.num).rows) == gaussians.num


def test_a_scene_without_a_field_stands_still(frames):
    scene = DeformingScene(start_gaussians(frames[:1], 0, 2.0))
    assert scene.at(jnp.asarray(0.7)) is scene.gaussians


@pytest.fixture(scope="module")
def learned(frames, lesson):
    problem, run = Deform(CONFIG).start(frames, lesson)
    first = [sight(problem, run, i) for i in range(len(frames))]
    ticks = drive(Deform(CONFIG), problem, run)
    infos = [jax.device_get(now.info) for now in ticks]
    return problem, ticks.run, first, infos


class TestLearning:
    @pytest.mark.thorough
    def test_all_frames_get_better(self, learned):
        problem, run, first, infos = learned
        now = [sight(problem, run, i) for i in range(len(first))]
        assert not any(info["skipped"] for info in infos)
        assert np.mean(now) > np.mean(first) + 1.5
        assert min(now) > min(first) + 1
        # Part of it is due to deformation: rendered at the time of the first frame, the last is worse.
        last = len(first) - 1
        assert now[last] > sight(problem, run, last, problem.seen[0].time) + 0.3

    @pytest.mark.thorough
    def test_features_approach_those_of_the_teacher(self, learned):
        *_, infos = learned
        assert {"node", "structure"} <= set(infos[-1])
        assert infos[-1]["feature"] < 0.6 * infos[0]["feature"]

    @pytest.mark.thorough
    def test_the_field_is_added_after_the_warm_up_and_the_graph_later(self, learned):
        *_, infos = learned
        assert next(i for i, info in enumerate(infos) if "planes" in info) == 8
        assert next(i for i, info in enumerate(infos) if "node" in info) == 8 + 35

    @pytest.mark.thorough
    def test_a_run_continued_past_a_stage_of_its_config_enters_it(self, frames, lesson):
        """Regression test: with a shorter warm-up than the earlier config's, the scene never deformed."""
        problem, run = Deform(CONFIG).start(frames, lesson)
        after = Deform(CONFIG).between(problem, run.having(step=60), 0.8)
        assert after.params.field is not None
        assert len(after.kept.graphs) == len(frames)

    @pytest.mark.thorough
    def test_depth_that_is_not_finite_is_unknown(self, frames):
        depths = frames[0].depths.copy()
        depths[0, 10, 10], depths[0, 11, 11], depths[0, :, :9] = np.nan, np.inf, 1e10
        method = Deform(replace(CONFIG, warmup=1, iterations=0))
        ticks = drive(method, *method.start([replace(frames[0], depths=depths)]))
        info = jax.device_get(next(ticks).info)
        assert np.isfinite(info["loss"])
        assert not info["skipped"]
        assert ticks.problem.radius < 1

    @pytest.mark.thorough
    def test_pixels_that_do_not_count_may_be_nan(self, frames):
        """And where none counts, there is no PSNR."""
        frame = replace(frames[0], images=frames[0].colors, masks=frames[0].masks.copy())
        frame.images[0, :, :20], frame.masks[0, :, :20] = np.nan, False
        covered = replace(frame, images=np.full_like(frame.images, np.nan), masks=np.zeros_like(frame.masks))
        method = Deform(replace(CONFIG, warmup=2, iterations=0, warmup_frames="all"))
        infos = [jax.device_get(now.info) for now in drive(method, *method.start([frame, covered]))]
        assert not any(info["skipped"] for info in infos)
        assert sorted(np.isnan(info["psnr"]) for info in infos) == [False, True]

    @pytest.mark.thorough
    def test_rates_decay_over_warm_up_and_joint_steps(self, frames):
        """The optimizer is reset when deformation begins; its schedule continues."""
        method = Deform(replace(CONFIG, warmup=3, iterations=3, schedule="cosine", warmup_frames="all"))
        problem, run = method.start(frames)
        means = [np.array(run.params.gaussians.means)]
        means += [np.array(now.run.params.gaussians.means) for now in drive(method, problem, run)]
        steps = [np.abs(b - a).max() for a, b in pairwise(means)]
        # Adam's first step is as long as the learning rate, which step 3 of 6 has halved.
        fall = 0.5 * (1 + np.cos(np.pi * 3 / 6))
        np.testing.assert_allclose(steps[3] / steps[0], fall, rtol=0.02)

    @pytest.mark.slow
    def test_those_that_moved_farthest_keep_deforming(self, frames, tmp_path):
        method = Deform(replace(CONFIG, nodes=0, warmup=2, iterations=12, moving_share=0.25))
        ticks, gate = drive(method, *method.start(frames)), 2 + 3
        for now in ticks:
            if now.step == gate:
                before = jax.tree.map(jnp.copy, now.run.params)
            if now.step == 9:
                save_checkpoint(tmp_path / "run.npz", now.run)
        problem, run = now.problem, ticks.run
        rows, count = np.asarray(run.kept.moving), before.gaussians.num
        assert len(rows) == round(count / 4)
        then = np.stack([before.at(frame.time).means for frame in problem.seen])
        far = np.linalg.norm(then - before.gaussians.means, axis=-1).max(axis=0)
        assert far[rows].min() >= np.delete(far, rows).max()
        at = now.result.at(0.7).means
        still = np.delete(np.arange(count), rows)
        np.testing.assert_array_equal(at[still], run.params.gaussians.means[still])
        assert np.abs(np.asarray(at - run.params.gaussians.means))[rows].max() > 0
        # Resumed from the checkpoint, it ends with the same bits.
        again, _ = load_checkpoint(tmp_path / "run.npz")
        *_, other = drive(method, problem, again)
        jax.tree.map(np.testing.assert_array_equal, run.params, other.run.params)

    @pytest.mark.slow
    def test_with_a_graph_it_goes_on_to_the_same_bits(self, learned, frames, lesson, tmp_path):
        problem, whole, *_ = learned
        for now in drive(Deform(CONFIG), *Deform(CONFIG).start(frames, lesson)):
            if now.step == 50:  # after the graph was built
                save_checkpoint(tmp_path / "run.npz", now.run)
                break
        again, _ = load_checkpoint(tmp_path / "run.npz")
        *_, last = drive(Deform(CONFIG), problem, again)
        jax.tree.map(np.testing.assert_array_equal, whole.params, last.run.params)

    def test_invalid_gaussians_are_left_out(self, frames):
        given = start_gaussians(frames[:1], 0, 2.0)
        means = np.array(given.means)
        means[:3] = np.nan
        spoilt = eqx.tree_at(lambda g: g.means, given, jnp.asarray(means))
        _, run = Deform(CONFIG).start(frames, gaussians=spoilt)
        assert run.params.gaussians.num == given.num - 3
        nowhere = eqx.tree_at(lambda g: g.means, given, jnp.asarray(np.nan * means))
        with pytest.raises(ValueError, match="gaussians: expected at least one"):
            Deform(CONFIG).start(frames, gaussians=nowhere)

    @pytest.mark.thorough
    def test_half_precision_is_learned_from_in_single(self, frames):
        """Regression test: in half precision, Adam divided 0 by 0, and all Gaussians were silently culled."""
        given = start_gaussians(frames, 0, CONFIG.start_pixels)
        halved = eqx.tree_at(lambda g: g.sh0, given, given.sh0.astype(jnp.float16))
        method = Deform(replace(CONFIG, warmup=2, iterations=0))
        *_, last = drive(method, *method.start(frames, gaussians=halved))
        assert last.run.params.gaussians.sh0.dtype == jnp.float32
        assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(last.run.params.gaussians))

    def test_given_gaussians_are_not_donated(self, frames, lesson):
        """They have the shapes of those that `learned` starts from, so its compiled program is reused."""
        given, method = start_gaussians(frames, 0, CONFIG.start_pixels), Deform(CONFIG)
        next(drive(method, *method.start(frames, lesson, gaussians=given)))
        assert not given.means.is_deleted()


@pytest.mark.thorough
def test_the_class_of_a_trained_scene_is_the_teachers(learned):
    """Tools are masked, so there is a single class."""
    _, run, *_ = learned
    found = jax.jit(prompt_probabilities)(run.params.gaussians.features, np.float32(CODES))
    assert (np.asarray(found)[:, 0] > 0.9).mean() > 0.8


@pytest.mark.thorough
@pytest.mark.parametrize("smaller", [1, 2])
def test_pixels_that_do_not_count_have_no_label(frames, smaller):
    """Otherwise, tissue behind a tool would learn the tool's features."""
    counts = np.ones_like(frames[0].masks)
    counts[0, 10:20, 30:44] = False
    ids = np.ones(counts.shape[1:], np.int32)[::smaller, ::smaller]
    problem, _ = Deform(CONFIG).start([replace(frames[0], masks=counts)], Lesson([ids], CODES))
    np.testing.assert_array_equal(problem.ids[0] == 1, counts[0, ::smaller, ::smaller])
    np.testing.assert_array_equal(problem.ids[0] == -1, ~counts[0, ::smaller, ::smaller])


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(PRESETS))
def test_presets_learn(name, frames, lesson):
    config = replace(
        PRESETS[name], warmup=0, iterations=6, start_pixels=2.0, nodes=0, channels=4, warmup_frames="all"
    )
    config = replace(config, deformation=replace(config.deformation, resolution=8, levels=1, channels=2))
    config = replace(config, graph=replace(config.graph, after=0, nodes=12, neighbors=2, matches=2, window=1))
    method = Deform(config)
    infos = [jax.device_get(now.info) for now in drive(method, *method.start(frames, lesson))]
    assert not any(info["skipped"] for info in infos)
    assert infos[-1]["rgb"] < infos[0]["rgb"]
    assert ({"spatial", "temporal"} if name == "clin" else {"node", "structure"}) <= set(infos[-1])
