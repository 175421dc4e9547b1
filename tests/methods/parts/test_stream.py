"""One step of streaming: its loss, its derivatives, and what it may change; and its loss as residuals."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import lineax
import numpy as np
import optimistix
import pytest

from gsjax.methods.parts.config import PartsConfig, StreamConfig
from gsjax.methods.parts.residual import pose_residual
from gsjax.methods.parts.screws import motions_of, pose_of
from gsjax.methods.parts.stream import (
    posed,
    skinning_weights,
    stream_loss,
    stream_step,
    tearing,
)
from gsjax.methods.parts.weights import SimplexTable, new_field
from gsjax.optim.least_squares import LEVENBERG_MARQUARDT, least_squares_step
from gsjax.scene.feature_grid import FeatureGridConfig
from gsjax.scene.frame import Frame
from gsjax.scene.handles import HandlePose, at_rest
from gsjax.scene.render import render
from tests.methods.parts.two_boxes import PARTS, batch_of, canonical_of, params_of, shifted, soft, two_boxes

CONFIG = StreamConfig()


def loss_and_info(params, batch):
    return stream_loss(CONFIG)(params, batch, step=0, key=None)


@pytest.fixture(scope="module")
def boxes():
    return two_boxes()


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("of", ["pose", "field"])
def test_derivatives_are_those_of_finite_differences(boxes, of):
    """For the field without the tearing loss, from which it does not learn."""
    batch, bodies = batch_of(boxes, jnp.float64)
    moved = shifted(0.01, jnp.float64)
    quats = moved.quats.at[1].set(jnp.array([1.0, 0.02, -0.03, 0.05]))
    params = params_of(HandlePose(quats, moved.translations), soft(bodies, dtype=jnp.float64), bodies)
    config = StreamConfig(tear_weight=0.3 if of == "pose" else 0.0)

    @jax.jit
    def loss(one):
        return stream_loss(config)(params._replace(**{of: one}), batch, step=0, key=None)[0]

    here, step, rng = getattr(params, of), 1e-6, np.random.default_rng(0)
    slope = jax.jit(jax.grad(loss))(here)
    for _ in range(3):
        way = jax.tree.map(lambda a: rng.normal(size=a.shape), here)
        ahead, behind = (loss(jax.tree.map(lambda a, b, s=s: a + s * b, here, way)) for s in (step, -step))
        expected = sum(np.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (slope, way)), strict=True))
        assert float(ahead - behind) / (2 * step) == pytest.approx(float(expected), rel=1e-3)


@pytest.mark.thorough
def test_the_past_teaches_the_field_alone(boxes):
    batch, bodies = batch_of(boxes)
    params = params_of(shifted(0.02), soft(bodies), bodies)

    batch = batch._replace(past=((batch.now, shifted(0.01)),))
    slope = jax.jit(jax.grad(lambda params: loss_and_info(params, batch)[1]["past"]))(params)
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(slope.pose))
    assert np.abs(slope.field).max() > 0


@pytest.mark.thorough
def test_what_a_step_may_change(boxes):
    """The background's handle and empty slots stay fixed, and quaternions keep unit length."""
    batch, bodies = batch_of(boxes)
    params = params_of(shifted(0.02), soft(bodies), bodies)
    step = stream_step(CONFIG)
    state, update = step.init(params), jax.jit(step.update)
    before = np.asarray(params.pose.translations)
    for i in range(3):
        params, state, info = update(params, state, batch._replace(progress=i / 3), step=i, key=None)
    assert not info["skipped"]
    after = np.asarray(params.pose.translations)
    np.testing.assert_array_equal(after[0], 0)
    np.testing.assert_array_equal(after[3], before[3])
    np.testing.assert_allclose(np.linalg.norm(params.pose.quats, axis=1), 1, rtol=1e-6)
    assert np.linalg.norm(after[1]) < np.linalg.norm(before[1])
    weights = np.asarray(jax.jit(skinning_weights)(params.field, batch.canonical))
    assert (weights[:, 3] == 0).all()
    assert np.abs(state.pulls).max() > 0


@pytest.mark.thorough
def test_what_both_plans_need_is_reported(boxes):
    """The capacities for this frame and for past ones, also if the first plan is too small."""
    batch, bodies = batch_of(boxes)
    params = params_of(shifted(0.0), soft(bodies), bodies)
    small = batch._replace(plan=replace(batch.plan, capacity=64))
    info = loss_and_info(params, small)[1]
    assert info["overflow"]
    assert min(info["needed"]) > 64


@jax.jit
def depths_at_rest(batch):
    gaussians = posed(batch.canonical, batch.weights, at_rest(PARTS))
    return render(gaussians, batch.now.cameras, batch.plan).depths


@pytest.mark.thorough
def test_depth_tells_what_colour_does_not(boxes):
    batch, bodies = batch_of(boxes, past=False)
    frame = batch.now
    seen = Frame(frame.images, depths_at_rest(batch), frame.cameras, frame.masks)
    params = params_of(shifted(0.02), soft(bodies), bodies)
    without, with_depth = (loss_and_info(params, batch._replace(now=now))[0] for now in (batch.now, seen))
    assert with_depth > without
    right = params_of(at_rest(PARTS), 20 * soft(bodies), bodies)
    _, info = loss_and_info(right, batch._replace(now=seen))
    assert info["now"] < 0.05 * (with_depth - without) + 5e-3


@pytest.mark.thorough
def test_what_moves_together_is_not_torn(boxes):
    canonical, bodies = canonical_of(boxes)
    weights = jax.nn.one_hot(bodies, PARTS)
    scale = jnp.float32(0.005)
    torn = jax.jit(tearing)
    assert torn(canonical, weights, at_rest(PARTS), scale) == 0
    apart = torn(canonical, weights, shifted(0.05), scale)
    # Neighbours on the floor stay behind; those on the same box do not.
    floor = np.asarray(canonical.neighbors) >= len(bodies)
    assert apart == pytest.approx(floor.mean() * 300 / 301, rel=1e-3)
    assert torn(canonical, weights, shifted(0.5), scale) < 1.02 * apart
    program = torn.lower(canonical, weights, at_rest(PARTS), scale).as_text()
    assert "HIGHEST" in program
    assert "DEFAULT" not in program  # TF32 on GPUs that have it


@pytest.mark.thorough
def test_a_grid_and_a_table_of_logits_serve_alike(boxes):
    canonical, _ = canonical_of(boxes)
    config = PartsConfig(grid=FeatureGridConfig(3, 4, 16, 8, 2, 8))
    grid, located = new_field(jax.random.key(0), config, canonical.movable.means, PARTS)
    canonical = canonical._replace(located=located)
    table = jax.jit(type(grid).at)(grid, canonical.located)
    weights = jax.jit(skinning_weights)
    np.testing.assert_array_equal(weights(grid, canonical), weights(table, canonical))


@pytest.mark.thorough
def test_weights_stay_on_the_simplex_and_what_is_not_alive_gets_none(boxes):
    batch, bodies = batch_of(boxes)
    mixed = 0.7 * jax.nn.one_hot(bodies, PARTS) + 0.3 / 3 * batch.canonical.alive
    params = params_of(shifted(0.01), SimplexTable(mixed), bodies)
    step = stream_step(StreamConfig(field_rate=0.05))
    state = step.init(params)
    update = jax.jit(lambda p, s: step.update(p, s, batch, step=0, key=None))
    for _ in range(3):
        params, state, info = update(params, state)
    assert not info["skipped"]
    weights = np.asarray(params.field.weights)
    assert (weights >= 0).all()
    assert (weights[:, 3] == 0).all()
    np.testing.assert_allclose(weights.sum(-1), 1, atol=1e-6)
    assert np.abs(weights - mixed).max() > 0.05


@pytest.mark.thorough
def test_several_frames_of_the_past_count_in_the_mean(boxes):
    batch, bodies = batch_of(boxes)
    params = params_of(shifted(0.01), soft(bodies), bodies)
    then = [(batch.now, shifted(by)) for by in (0.0, 0.01, 0.02)]

    def of_past(past):
        return loss_and_info(params, batch._replace(past=tuple(past)))[1]["past"]

    one_by_one = [float(of_past([one])) for one in then]
    assert len(set(one_by_one)) == 3
    assert float(of_past(then)) == pytest.approx(np.mean(one_by_one), rel=1e-5)


def forward(batch):
    """The batch with a plan for forward-mode derivatives."""
    return batch._replace(plan=replace(batch.plan, derivative="forward"))


def half_squares(residuals):
    return 0.5 * sum(float(np.vdot(r, r)) for r in jax.tree.leaves(residuals))


@pytest.mark.thorough
@pytest.mark.parametrize("depth", [False, True])
def test_half_the_squares_are_the_loss_without_ssim(boxes, depth):
    batch, bodies = batch_of(boxes, past=False)
    frame, batch = batch.now, batch._replace(progress=0.5)
    if depth:
        depths = jnp.full(frame.images.shape[:-1], 0.6)
        batch = batch._replace(now=Frame(frame.images, depths, frame.cameras, frame.masks))
    config, pose = StreamConfig(l1_weight=1.0, tear_weight=0.3, hold_weight=0.0), shifted(0.02)
    certain = params_of(pose, SimplexTable(batch.weights), bodies)
    loss = stream_loss(config)(certain, batch, step=0, key=None)[0]
    residuals, info = pose_residual(
        motions_of(pose), batch, step=0, key=None, config=config, block=1, softness=1e-6
    )
    assert residuals.keys() == ({"color", "tear", "depth"} if depth else {"color", "tear"})
    assert half_squares(residuals) / batch.now.masks.sum() == pytest.approx(float(loss), rel=2e-3)
    assert not info["overflow"]


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_the_derivative_of_residuals_is_that_of_differences(boxes):
    batch = forward(batch_of(boxes, jnp.float64, past=False)[0])
    start = motions_of(shifted(0.01, jnp.float64))

    @jax.jit
    def values(twists):
        found, _ = pose_residual(start @ type(start).exp(twists), batch, step=0, key=None, config=CONFIG)
        return jnp.concatenate([r.ravel() for r in jax.tree.leaves(found)])

    rng = np.random.default_rng(0)
    at, way, far = jnp.zeros((PARTS, 6)), jnp.asarray(rng.normal(size=(PARTS, 6))), 1e-6
    still = way.at[1:3].set(0)  # twists of the background and the empty slot alone
    np.testing.assert_array_equal(jax.jvp(values, (at,), (still,))[1], 0)
    way = way - still
    found = jax.jvp(values, (at,), (way,))[1]
    expected = (values(far * way) - values(-far * way)) / (2 * far)
    # Pixels jump where a faint Gaussian is cut off, which the derivative does not include.
    cosine = jnp.vdot(found, expected) / (jnp.linalg.norm(found) * jnp.linalg.norm(expected))
    assert cosine > 0.99


# The background and the empty slot have zero columns, so the normal equations are singular.
UNDAMPED = optimistix.GaussNewton(1e-4, 1e-5, linear_solver=lineax.AutoLinearSolver(well_posed=False))


@pytest.mark.slow
@pytest.mark.parametrize("solver", [LEVENBERG_MARQUARDT, UNDAMPED])
def test_gauss_newton_brings_handles_home(boxes, solver):
    batch = forward(batch_of(boxes, past=False)[0])
    frame = batch.now
    seen = Frame(frame.images, depths_at_rest(batch), frame.cameras, frame.masks)
    batch = batch._replace(now=seen)

    def residual(motions, batch, *, step, key):
        return pose_residual(motions, batch, step=step, key=key, config=CONFIG, block=2)

    step = least_squares_step(residual, solver)
    motions = motions_of(shifted(0.01))
    update, state = jax.jit(lambda *of: step.update(*of, batch, step=0, key=None)), step.init(motions)
    for _ in range(8):
        motions, state, info = update(motions, state)
    assert not info["skipped"]
    off = np.linalg.norm(pose_of(motions).translations, axis=-1)[1:3]
    assert off.max() < 0.002
