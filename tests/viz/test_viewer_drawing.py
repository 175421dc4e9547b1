"""The viewer's own pictures: few programs, right colours, and a thread that merges requests."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax.viz.viewer.drawing
from gsjax.scene.render import plan_render, render
from gsjax.viz.viewer.cameras import browser_camera
from gsjax.viz.viewer.debounce import Debouncer
from gsjax.viz.viewer.drawing import Drawer, Drawn, picture_of, recolored
from tests.viz.scenes import ahead, cloud

# our picture


def counted(monkeypatch):
    """A list that grows each time the program that draws is traced."""
    traces = []

    def draw(*arguments, **options):
        traces.append(arguments)
        return render(*arguments, **options)

    monkeypatch.setattr(gsjax.viz.viewer.drawing, "render", draw)
    return traces


@pytest.mark.thorough
def test_moving_compiles_nothing_unless_a_plan_grows(monkeypatch):
    """From far away few tiles are touched, from close by all of them, which requires another plan."""
    traces, drawer = counted(monkeypatch), Drawer((0.2, 0.4, 0.6))
    gaussians = cloud(400)

    def at(x, z, turn=0.0):
        quat = np.array([1.0, turn, 0, 0]) / np.hypot(1.0, turn)
        return browser_camera(quat, np.array([x, 0, z]), 0.5, 96, 96)

    drawer(gaussians, at(0, -300.0))
    drawer(gaussians, at(0.1, -290.0))
    assert len(traces) == 1
    drawer(gaussians, at(0, 0.9))
    assert len(traces) == 2
    (plans,) = drawer._plans.values()
    (plan,) = plans.values()
    reference = jax.jit(
        lambda camera: render(gaussians, camera, plan, backgrounds=jnp.array([[0.2, 0.4, 0.6]]))
    )
    for camera in (at(0, 0.9), at(-0.2, 0.5, 0.05), at(0, -300.0)):
        drawn, expected = drawer(gaussians, camera), reference(camera)
        assert not expected.meta.overflow.any()
        np.testing.assert_allclose(drawn.colors, expected.colors[0], atol=2e-5)
        np.testing.assert_allclose(drawn.alphas, expected.alphas[0], atol=2e-5)
        assert (drawn.depths[drawn.alphas <= 0.5] == 0).all()
        assert (drawn.depths[drawn.alphas > 0.5] > 0).all()
    assert len(traces) == 2


@pytest.mark.slow
def test_scenes_of_fewer_gaussians_compile_nothing(monkeypatch):
    """Nor does a slightly larger scene after a larger one; and every scene gets its own picture."""
    traces, drawer = counted(monkeypatch), Drawer()
    for count, compiled in ((100, 1), (60, 1), (120, 2), (140, 2), (100, 2), (1, 2)):
        gaussians = cloud(count)
        drawn = drawer(gaussians, ahead())
        assert len(traces) == compiled
        alone = render(gaussians, ahead(), plan_render(gaussians, ahead()))
        np.testing.assert_allclose(drawn.colors, alone.colors[0], atol=1e-5)
        np.testing.assert_allclose(drawn.alphas, alone.alphas[0], atol=1e-5)


def test_pictures_of_what_was_drawn():
    drawn = Drawn(np.full((2, 2, 3), 0.5, np.float32), np.ones((2, 2)), np.array([[0, 1.0], [0.5, 2]]))
    assert (picture_of(drawn, "colour", None) == 128).all()
    assert picture_of(drawn, "alpha", None)[..., 1].tolist() == [[0, 255], [128, 255]]
    near, far = (picture_of(drawn, "depth", ends)[0, 0].sum() for ends in ((1.0, 2.0), (0.5, 1.0)))
    assert near > far


@pytest.mark.thorough
def test_recoloured_gaussians_have_that_colour_from_all_sides():
    gaussians = cloud(shN=np.ones((24, 3, 3)))
    red = recolored(gaussians, np.tile([1.0, 0, 0], (24, 1)))
    assert red.sh_degree == 0
    drawn = Drawer()(red, ahead())
    np.testing.assert_allclose(drawn.colors[..., 0], drawn.alphas, atol=1e-5)
    assert np.abs(drawn.colors[..., 1:]).max() < 1e-5


# threads


def test_requests_made_while_busy_are_merged():
    begun, go, done, runs = threading.Event(), threading.Event(), threading.Event(), []

    def work():
        runs.append(len(runs))
        begun.set()
        if len(runs) == 1:
            assert go.wait(30)
        else:
            done.set()

    worker = Debouncer(work)
    worker.request()
    assert begun.wait(30)
    for _ in range(5):
        worker.request()
    go.set()
    assert done.wait(30)
    worker.close()
    worker.request()
    assert runs == [0, 1]


def test_requests_that_never_settle_are_served_in_the_end():
    done = threading.Event()
    worker = Debouncer(done.set, settle_s=60.0, patience_s=0.2)
    worker.request()
    for _ in range(2000):
        worker.request()
        if done.wait(0.01):
            break
    assert done.is_set()
    worker.close()
