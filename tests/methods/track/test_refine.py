"""The refinement as residuals: same loss, correct derivative, and convergence of Levenberg-Marquardt."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from gsjax.methods.track.config import RefineConfig
from gsjax.methods.track.motion import Motion
from gsjax.methods.track.refine import refine_loss, refine_residual
from gsjax.optim.least_squares import least_squares_step
from gsjax.scene.frame import Frame
from tests.methods.track.ball_before_wall import OBJECT, batch_after

CONFIG = RefineConfig()
STILL = jaxlie.SE3.identity((1,))


@pytest.fixture
def batch():
    return batch_after([0.02, -0.01, 0.015, 0.0, 0.1, 0.05])


def half_squares(residuals) -> float:
    return 0.5 * sum(float(jnp.sum(r * r)) for r in jax.tree.leaves(residuals))


@pytest.mark.thorough
def test_half_the_squares_are_refines_loss(batch):
    nothing = Motion(jnp.zeros((1, 6)), jnp.zeros((OBJECT, 3)))
    loss = float(refine_loss(nothing, batch, step=0, key=None, config=CONFIG)[0])
    assert loss > 0.1
    found = [
        half_squares(
            refine_residual(STILL, batch, step=0, key=None, config=CONFIG, block=1, softness=softness)[0]
        )
        for softness in (1e-4, 0.3)
    ]
    assert found[0] == pytest.approx(1e3 * loss, rel=1e-3)
    assert found[1] < found[0]  # by the softness


@pytest.mark.thorough
def test_without_depth_there_is_colour_alone(batch):
    frame = Frame(batch.frame.images, None, batch.frame.cameras)
    options = {"step": 0, "key": None, "config": CONFIG, "block": 1}
    whole = refine_residual(STILL, batch, **options)[0]
    residuals, _ = refine_residual(STILL, batch._replace(frame=frame), **options)
    assert residuals.keys() == {"color"}
    np.testing.assert_array_equal(residuals["color"], whole["color"])


@pytest.mark.thorough
def test_pixels_that_fill_no_block_are_left_out(batch):
    residuals, _ = refine_residual(STILL, batch, step=0, key=None, config=CONFIG, block=5)
    assert residuals["color"].shape == (2, 9, 12, 3)
    assert residuals["depth"].shape == (2, 9, 12, 1)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_its_derivative_is_that_of_differences():
    batch = batch_after([0.01, 0.0, 0.0, 0.0, 0.05, 0.0])

    @jax.jit
    def values(xi):
        motions = jaxlie.SE3.exp(xi[None])
        residuals = refine_residual(motions, batch, step=0, key=None, config=CONFIG, softness=1.0)[0]
        return jnp.concatenate([r.ravel() for r in jax.tree.leaves(residuals)])

    at, direction = jnp.full(6, 1e-3), jnp.asarray([0.3, -0.2, 0.5, 1.0, -1.0, 0.5])
    _, found = jax.jvp(values, (at,), (direction,))
    step = 1e-6
    expected = (values(at + step * direction) - values(at - step * direction)) / (2 * step)
    # The derivative treats weights as constants, differences do not, so the two agree only roughly.
    cosine = jnp.vdot(found, expected) / (jnp.linalg.norm(found) * jnp.linalg.norm(expected))
    assert cosine > 0.99


@pytest.mark.thorough
def test_levenberg_marquardt_brings_the_group_home(batch):
    step = least_squares_step(lambda *args, **kw: refine_residual(*args, **kw, config=CONFIG))

    @jax.jit
    def advance(motions, state):
        return step.update(motions, state, batch, step=0, key=None)

    motions, state = STILL, step.init(STILL)
    for _ in range(8):
        motions, state, _ = advance(motions, state)
    np.testing.assert_allclose(motions.translation()[0], [0.02, -0.01, 0.015], atol=5e-4)
    np.testing.assert_allclose(motions.rotation().log()[0], [0.0, 0.1, 0.05], atol=1e-2)


@pytest.mark.thorough
def test_an_overflow_is_told(batch):
    small = replace(batch.plan, capacity=64)
    _, info = refine_residual(STILL, batch._replace(plan=small), step=0, key=None, config=CONFIG)
    assert bool(info["overflow"])
    assert int(info["needed"]) > 64
