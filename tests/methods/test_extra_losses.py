"""Custom losses beside those of a method: their gradients are right and take effect, and without any, nothing
changes."""

from dataclasses import replace
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.engine.drive import drive
from gsjax.engine.track.tracking import track
from gsjax.losses.extra import extra_terms
from gsjax.methods.deform import Deform, DeformConfig, deform_loss, with_field
from gsjax.methods.deform import batch_of as deform_batch_of
from gsjax.methods.fit import Fit, FitConfig, StartConfig, fit_loss
from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.refine import RefineBatch as PartsBatch
from gsjax.methods.parts.refine import RefineParams, refine_step
from gsjax.methods.parts.stream import skinning_weights, stream_loss
from gsjax.methods.track import AlignConfig
from gsjax.methods.track.config import RefineConfig
from gsjax.methods.track.motion import Motion
from gsjax.methods.track.refine import refine, refine_loss
from gsjax.scene.deformation import DeformationConfig, Nodes
from gsjax.scene.handles import at_rest
from tests.methods.fit.photographed_blobs import photographed_blobs
from tests.methods.parts.two_boxes import batch_of, params_of, shifted, soft, two_boxes
from tests.methods.track.ball_before_wall import batch_after

FIT = FitConfig(steps=4, cap=60, sh_degree=0, coarse_until=0.0, start=StartConfig(count=50))
TINY = DeformationConfig(resolution=16, time_resolution=6, levels=1, channels=4, hidden=16)
CALLS = []


def upwards(scene, rendered, frame):
    """Raises the first group, with a weight that outweighs all other losses."""
    CALLS.append(1)
    return -1e3 * jnp.mean(scene.gaussians.means[:, 2], where=scene.labels == 1)


def brighter(scene, rendered, frame):
    """Makes the rendered images brighter than the frame."""
    return jnp.mean((rendered.colors - frame.images - 1.0) ** 2)


def nothing(scene, rendered, frame):
    return jnp.zeros(())


HEIGHT_WEIGHT = 5.0


def height(scene, rendered, frame):
    CALLS.append(1)
    return HEIGHT_WEIGHT * jnp.mean(scene.gaussians.means[:, 2])


def mean_height(canonical):
    means = np.r_[canonical.movable.means, canonical.fixed.means]
    return HEIGHT_WEIGHT * means[:, 2].mean()


def uphill(means):
    """The gradient of `height`."""
    return np.broadcast_to([0.0, 0.0, HEIGHT_WEIGHT / len(means)], means.shape)


def slope_added(loss_with, params, batch):
    """The gradient of a method's loss with `height` minus that without."""

    @partial(jax.jit, static_argnums=0)
    def slope(extra, params):
        loss = loss_with(extra)
        return eqx.filter_grad(lambda params: loss(params, batch, step=0, key=None)[0])(params)

    return jax.tree.map(lambda a, b: np.asarray(a - b), slope((height,), params), slope((), params))


@pytest.fixture(scope="module")
def photographs():
    return photographed_blobs()


@pytest.fixture(scope="module")
def pictures():
    return two_boxes()


@pytest.fixture(scope="module")
def refined():
    """refined(*losses) -> the refinement of a ball that has sunk, with these custom losses; cached."""
    batch = batch_after([0.02, -0.01, -0.015, 0.0, 0.1, 0.05])
    batch = batch._replace(plan=replace(batch.plan, derivative="reverse"))
    still = Motion(jnp.zeros((1, 6)), jnp.zeros_like(batch.pose.means))
    config = RefineConfig(iterations=5)

    @cache
    def with_losses(*losses):
        return jax.device_get(jax.jit(lambda *given: refine(*given, config, losses))(still, batch))

    return with_losses


class TestInRefinement:
    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    @pytest.mark.parametrize("loss", [upwards, brighter])
    def test_its_derivative_is_that_of_differences(self, loss):
        batch = batch_after([0.01, 0.0, 0.0, 0.0, 0.05, 0.0])
        # No Gaussian is left out, however faint: finite differences would jump there, derivatives not.
        room = replace(batch.plan, capacity=200_000)
        batch = batch._replace(plan=replace(room, alpha_min=1e-9, min_transmittance=1e-12))
        direction = jnp.asarray([[0.3, -0.2, 0.5, 1.0, -1.0, 0.5]])

        @jax.jit
        def both(along):
            """What the custom loss adds to the loss at a motion along a line, and its reported value."""
            motion = Motion(along * direction, jnp.zeros_like(batch.pose.means))
            of = {"step": 0, "key": None, "config": RefineConfig()}
            value, info = refine_loss(motion, batch, extra_losses=(loss,), **of)
            return value - refine_loss(motion, batch, **of)[0], info["extra"]

        # Forward mode, for which this batch's plan is made; `refine` below uses reverse mode.
        (value, told), (found, _) = jax.jvp(both, (1e-3,), (1.0,))
        step = 1e-6
        expected = (both(1e-3 + step)[0] - both(1e-3 - step)[0]) / (2 * step)
        np.testing.assert_allclose(found, expected, rtol=1e-4)
        assert abs(expected) > 1e-3
        np.testing.assert_allclose(value, told[loss.__name__], rtol=1e-6)

    @pytest.mark.thorough
    def test_it_pulls_and_its_value_is_told(self, refined):
        plain, _, info = refined()
        pulled, _, told = refined(upwards, nothing)
        assert pulled.twists[0, 2] > 1e-3 > plain.twists[0, 2]
        assert told["extra"].keys() == {"upwards", "nothing"}
        assert "extra" not in info

    @pytest.mark.thorough
    def test_a_gradient_that_is_no_number_is_culled_and_counted(self, refined):
        def root(scene, rendered, frame):
            return jnp.mean(jnp.sqrt(0.0 * scene.gaussians.means))

        found, _, told = refined(root)
        assert np.isfinite(found.twists).all()
        assert told["culled"] > 0
        _, _, told = refined(nothing)
        assert told["culled"] == 0

    @pytest.mark.thorough
    def test_one_of_zero_leaves_every_bit(self, refined):
        plain, _, info = refined()
        with_zero, _, told = refined(nothing)
        jax.tree.map(np.testing.assert_array_equal, plain, with_zero)
        np.testing.assert_array_equal(info["loss"], told["loss"])


@pytest.fixture(scope="module")
def config(quick):
    align = AlignConfig(iterations=2, reach=0.0, turns=(), pixels=32, centers=32)
    return replace(quick, align=align, matching=False, headroom=1.52)


@pytest.mark.slow
def test_the_tracker_is_pulled_and_compiles_once(table, started, config):
    _, frames, _ = table()
    # With custom losses a refinement is always kept. Without any, the other groups would differ for that
    # reason alone.
    *_, plain = track(started, frames[0], frames[1:], config, extra_losses=(nothing,))
    calls, heights = [], []
    CALLS.clear()
    for now in track(started, frames[0], frames[1:], config, extra_losses=(upwards,)):
        calls.append(len(CALLS))
        heights.append(float(now.info["extra"]["upwards"]))
    assert calls[0] > 0
    assert calls == calls[:1] * len(calls)  # nothing was traced after the first frame

    def lift(now, group):
        scene, pose = now.result
        member = np.asarray(scene.labels[: scene.num_moving]) == group
        return float(np.asarray(pose.means)[member, 2].mean())

    assert plain.info["visible"][0]
    assert lift(now, 1) > lift(plain, 1) + 2e-3
    for group in range(2, started.num_objects + 1):
        assert abs(lift(now, group) - lift(plain, group)) < 3e-4
    assert heights[-1] < heights[0]


def over_time(photographs):
    """Photographs as if they had been taken one after the other."""
    return [replace(frame, time=np.asarray(i / 7)) for i, frame in enumerate(photographs)]


class TestOtherMethods:
    """The same custom loss added to those of a fit, of parts and of a deforming scene."""

    @pytest.mark.thorough
    def test_of_a_fit(self, photographs):
        method = Fit(FIT)
        problem, run = method.start(photographs)
        batch, _ = method.batch(problem, method.between(problem, run, 0.0), 0.0)
        added = slope_added(lambda extra: fit_loss(FIT, extra), run.params, batch)
        np.testing.assert_allclose(added.gaussians.means, uphill(run.params.gaussians.means), atol=1e-4)
        assert not np.any(added.gaussians.sh0)

    @pytest.mark.slow
    def test_of_parts(self, pictures):
        batch, bodies = batch_of(pictures)
        params = params_of(shifted(0.01), soft(bodies), bodies)
        added = slope_added(lambda extra: stream_loss(StreamConfig(), extra), params, batch)
        share = np.asarray(skinning_weights(params.field, batch.canonical)).sum(0)
        share = share / (batch.canonical.movable.num + batch.canonical.fixed.num)
        np.testing.assert_allclose(added.pose.translations[:, 2], HEIGHT_WEIGHT * share, atol=1e-4)
        assert np.any(added.field)

    @pytest.mark.slow
    def test_of_all_frames_of_parts(self, pictures):
        batch, _ = batch_of(pictures)
        scene, config = batch.canonical, PartsConfig()
        poses = jax.tree.map(lambda a: jnp.stack([a, a]), at_rest(len(scene.alive)))
        params = RefineParams(scene.movable, scene.fixed, poses)
        given = PartsBatch(
            scene, batch.weights, batch.now, jnp.int32(1), jnp.int32(0), jnp.int32(0), 0.0, batch.plan
        )

        @partial(jax.jit, static_argnums=0)
        def after(extra):
            step = refine_step(config, extra)
            return step.update(params, step.init(params), given, step=0, key=None)

        (plain, _, _), (pulled, _, info) = after(()), after((height,))
        assert np.all(pulled.movable.means[:, 2] <= plain.movable.means[:, 2])
        assert np.any(pulled.movable.means[:, 2] < plain.movable.means[:, 2])
        np.testing.assert_allclose(info["extra"]["height"], mean_height(scene), rtol=1e-4)

    @pytest.mark.slow
    def test_of_a_deforming_scene(self, photographs):
        config = DeformConfig(start_pixels=2.0, deformation=TINY)
        problem, run = Deform(config).start(over_time(photographs))
        scene, _ = with_field(config, problem, run.params)
        added = slope_added(lambda extra: deform_loss(config, extra), scene, deform_batch_of(problem, run, 0))
        np.testing.assert_allclose(added.gaussians.means, uphill(scene.gaussians.means), atol=1e-4)
        assert np.any(added.field.layers[-1].weight)  # through the deformation

    @pytest.mark.thorough
    @pytest.mark.parametrize("nodes", [0, 12])
    def test_a_deforming_scene_at_its_time_is_what_was_drawn(self, photographs, nodes):
        def apart(scene, rendered, frame):
            return jnp.abs(scene.at(frame.time).means - scene.gaussians.means).max()

        def moved(scene, rendered, frame):
            return jnp.abs(scene.gaussians.means - scene.canonical.gaussians.means).max()

        config = DeformConfig(start_pixels=2.0, deformation=TINY, nodes=nodes)
        problem, run = Deform(config).start(over_time(photographs))
        scene, moving = with_field(config, problem, run.params)
        assert isinstance(moving, Nodes) == bool(nodes)
        last = scene.field.layers[-1].weight
        scene = eqx.tree_at(lambda s: s.field.layers[-1].weight, scene, jnp.full_like(last, 0.05))
        batch = deform_batch_of(problem, run, 0)._replace(moving=moving)
        _, info = deform_loss(config, (apart, moved))(scene, batch, step=0, key=None)
        assert info["extra"]["moved"] > 1e-4
        assert info["extra"]["apart"] < 1e-6

    @pytest.mark.thorough
    def test_loops_hand_them_on_and_compile_once(self, photographs):
        method, calls = Fit(FIT, (height,)), []
        CALLS.clear()
        for now in drive(method, *method.start(photographs), progress=lambda i: 0.5 + i / 8):
            calls.append(len(CALLS))
            assert np.isfinite(now.info["extra"]["height"])
        assert len(calls) == 4
        assert calls[0] > 0
        assert calls == calls[:1] * 4

        config = DeformConfig(start_pixels=2.0, warmup=2, iterations=0, deformation=TINY)
        method = Deform(config, (height,))
        for now in drive(method, *method.start(over_time(photographs))):
            assert np.isfinite(now.info["extra"]["height"])
        assert now.step == 2


class Unhashable:
    __hash__ = None

    def __call__(self, scene, rendered, frame):
        return jnp.zeros(())


def started_with(loss, photographs):
    method = Fit(FIT, (loss,))
    return method, *method.start(photographs)


@pytest.mark.thorough
def test_what_they_take_from_outside_is_read_at_each_step(photographs, monkeypatch):
    values = []
    for now in drive(*started_with(height, photographs), progress=lambda i: 0.5 + i / 8):
        values.append(float(now.info["extra"]["height"]))
        monkeypatch.setitem(globals(), "HEIGHT_WEIGHT", 0.0)
    assert values[0] != 0
    assert values[1:] == [0.0] * 3


@pytest.mark.thorough
def test_where_one_is_never_finite_it_is_named(photographs):
    def nanny(scene, rendered, frame):
        return jnp.mean(jnp.log(rendered.alphas - 2.0))

    method = Fit(replace(FIT, steps=24), (nothing, nanny))
    with pytest.warns(RuntimeWarning, match="10 steps in a row changed nothing, .*: nanny is nan$"):
        list(drive(method, *method.start(photographs), progress=lambda i: 0.5 + i / 24))


@pytest.mark.thorough
def test_a_tick_is_gone_on_from_twice_and_its_losses_are_missed(tmp_path):
    taken = gsjax.open_photographs("simulated:tabletop?width=32&height=24&frames=1")
    ticks = gsjax.fit(taken, FIT, extra_losses=(height,))
    first = next(ticks)
    gsjax.save(tmp_path / "fit.npz", first)
    next(ticks)
    kept, ends = gsjax.load(tmp_path / "fit.npz"), []
    for _ in range(2):
        *_, end = gsjax.fit(taken, FIT, after=kept, extra_losses=(height,))
        ends.append(np.asarray(end.result.means))
    np.testing.assert_array_equal(*ends)
    with pytest.warns(UserWarning, match="custom losses that are not given now: height"):
        gsjax.fit(taken, FIT, after=kept)
    with pytest.raises(ValueError, match="after: expected a tick whose loop has taken no further step"):
        gsjax.fit(taken, FIT, after=first, extra_losses=(height,))


class TestMistakes:
    @pytest.mark.parametrize(
        ("losses", "said"),
        [
            ([nothing], r"expected a tuple of functions, such as \(loss,\), found list"),
            (nothing, "found function"),
            ((1.0,), "expected functions loss"),
            ((nothing, nothing), "two named 'nothing'"),
            ((lambda *_: jnp.zeros(3),), r"expected a scalar from <lambda>, found shape \(3,\)"),
            ((lambda *_: None,), "expected a scalar from <lambda>, found NoneType"),
            ((lambda *_: (jnp.zeros(()), {}),), "expected a scalar from <lambda>, found tuple"),
            ((partial(nothing), nothing), "two named 'nothing'"),
            ((Unhashable(),), "found Unhashable, which cannot be hashed"),
        ],
    )
    def test_what_is_no_loss_is_refused(self, losses, said):
        with pytest.raises(ValueError, match=f"extra_losses: .*{said}"):
            extra_terms(losses, None, None, None)

    def test_what_fails_in_one_says_in_which(self):
        def wrong(scene, rendered, frame):
            return float(scene[0])

        with pytest.raises(jax.errors.ConcretizationTypeError) as failed:
            jax.jit(lambda scene: extra_terms((wrong,), scene, None, None))(jnp.zeros(3))
        assert "in the extra loss wrong(scene, rendered, frame)" in failed.value.__notes__[0]

    @pytest.mark.thorough
    @pytest.mark.usefixtures("as_users_run")
    def test_a_list_is_refused_by_methods(self, table, started, config):
        _, frames, _ = table()
        given = {"extra_losses": [nothing]}
        for refuse in (
            lambda: next(track(started, frames[0], frames[1:], config, **given)),
            lambda: Fit(FIT, **given),
            lambda: Deform(DeformConfig(), **given),
        ):
            with pytest.raises(ValueError, match="extra_losses: expected a tuple of functions"):
                refuse()

    @pytest.mark.thorough
    def test_a_tracker_that_refines_nothing_has_no_use_for_one(self, table, started, config):
        _, frames, _ = table()
        without = replace(config, refine=replace(config.refine, iterations=0))
        with pytest.raises(ValueError, match=r"extra_losses: expected none with config\.refine\.iterations"):
            next(track(started, frames[0], frames[1:], without, extra_losses=(nothing,)))
        with pytest.raises(ValueError, match="extra_losses: expected none under budget_ms"):
            next(track(started, frames[0], frames[1:], config, budget_ms=50.0, extra_losses=(nothing,)))
