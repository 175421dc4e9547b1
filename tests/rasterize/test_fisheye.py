"""Fisheye cameras: against OpenCV, the float64 reference and central differences, and at their extremes."""

import dataclasses
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import relative_error
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization
from gsjax.rasterize.reference import rasterization_reference

WIDTH, HEIGHT = 40, 30
K = np.array([[14.0, 0.3, 21.0], [0.0, 13.0, 14.0], [0.0, 0.0, 1.0]])
COEFFS = np.array([0.06, -0.02, 0.004, -0.0005])
FIRST = ("means", "quats", "scales", "opacities", "colors")
PLAN = Plan(WIDTH, HEIGHT, 4096, render_mode="RGB+ED", rasterize_mode="antialiased")


def scene_around(dtype, num=24, widest=1.9, seed=0):
    """Gaussians a few degrees wide around a camera, from its optical axis to more than 90 degrees off it."""
    rng = np.random.default_rng(seed)
    angle, turn = np.linspace(1e-3, widest, num), rng.uniform(0, 2 * np.pi, num)
    distance = rng.permutation(num) * 0.1 + 1.0
    around = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    scene = {
        "means": distance[:, None] * np.stack(around, axis=1),
        "quats": rng.normal(size=(num, 4)),
        "scales": rng.uniform(0.03, 0.2, (num, 3)) * distance[:, None],
        "opacities": rng.uniform(0.3, 0.9, num),
        "colors": rng.uniform(size=(num, 3)),
        "viewmats": np.eye(4)[None],
        "Ks": K[None],
        "fisheye": COEFFS[None],
    }
    return {name: np.asarray(value, dtype) for name, value in scene.items()}


@partial(jax.jit, static_argnames="plan")
def image(scene, plan=PLAN):
    colors, alphas, meta = rasterization(**scene, width=WIDTH, height=HEIGHT, plan=plan)
    return jnp.concatenate([colors, alphas], axis=-1), meta


@partial(jax.jit, static_argnames="plan")
@partial(jax.value_and_grad, has_aux=True)
def drawn(scene, weights, plan=PLAN):
    values, meta = image(scene, plan)
    return jnp.vdot(values, weights), (values, meta)


@jax.jit
@partial(jax.value_and_grad, has_aux=True)
def expected(scene, weights):
    views = (scene[name][0] for name in ("viewmats", "Ks"))
    result = rasterization_reference(
        *(scene[name] for name in FIRST),
        *views,
        WIDTH,
        HEIGHT,
        fisheye=scene["fisheye"][0],
        render_mode="RGB+ED",
        rasterize_mode="antialiased",
    )
    values = jnp.concatenate([result.colors, result.alphas], axis=-1)[None]
    return jnp.vdot(values, weights), (values, result.doubtful)


@pytest.fixture
def weights():
    return np.random.default_rng(1).normal(size=(1, HEIGHT, WIDTH, 5))


@pytest.mark.thorough
def test_centres_lie_where_opencv_projects_them():
    scene = scene_around(np.float32, widest=1.5)
    straight = np.array([[14.0, 0, 21.0], [0, 13.0, 14.0], [0, 0, 1]])
    half = np.array([[0.0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    means = np.float64(scene["means"])[:, None]
    pixels = cv2.fisheye.projectPoints(means, np.zeros(3), np.zeros(3), straight - half, COEFFS)[0][:, 0]
    meta = image(scene | {"Ks": np.float32(straight)[None]})[1]
    seen = np.asarray(meta.radii[0, :, 0]) > 0
    assert seen.sum() > 15
    np.testing.assert_allclose(np.asarray(meta.means2d)[0, seen], pixels[seen] + 0.5, atol=1e-4)
    np.testing.assert_allclose(meta.depths[0, seen], np.linalg.norm(means[seen, 0], axis=1), rtol=1e-6)


@pytest.mark.thorough
def test_image_and_gradients_are_those_of_the_reference(weights):
    (_, (got, meta)), slopes = drawn(scene_around(np.float32), np.float32(weights))
    with jax.enable_x64(True):
        certain = ~np.asarray(expected(scene_around(np.float64), weights)[0][1][1])
        weights = np.where(certain[None, ..., None], weights, 0.0)
        (_, (want, _)), exact = jax.device_get(expected(scene_around(np.float64), weights))
    slopes = drawn(scene_around(np.float32), np.float32(weights))[1]
    assert int(meta.culled[0]) == 0
    assert (np.asarray(want[..., 4]) > 0.05).mean() > 0.3
    assert relative_error(np.asarray(got), want, certain[None, ..., None]) < 2e-5
    for name, slope in exact.items():
        # The gradient of the lens sums terms of up to 1.9^9 that cancel.
        assert relative_error(np.asarray(slopes[name]), slope) < (1e-3 if name == "fisheye" else 2e-4), name


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", scene_around(np.float32))
def test_each_argument_by_central_differences_and_jvp_against_vjp(name, weights):
    """On Gaussians so large and faint that no threshold is near any pixel."""
    scene = scene_around(np.float64, 6, 1.0)
    scene |= {"scales": scene["scales"] + 1.5, "opacities": scene["opacities"] / 2}
    direction = np.random.default_rng(2).normal(size=scene[name].shape)

    def moved(step):
        return scene | {name: scene[name] + step * direction}

    by_vjp = np.vdot(drawn(scene, weights)[1][name], direction)
    forward = dataclasses.replace(PLAN, derivative="forward")
    push = jax.jvp(lambda a: image(scene | {name: a}, forward)[0], (scene[name],), (direction,))[1]
    np.testing.assert_allclose(np.vdot(push, weights), by_vjp, rtol=1e-9)

    def central(step):
        return (drawn(moved(step), weights)[0][0] - drawn(moved(-step), weights)[0][0]) / (2 * step)

    np.testing.assert_allclose((4 * central(3e-6) - central(6e-6)) / 3, by_vjp, rtol=1e-6)
    assert abs(by_vjp) > 1e-6


@pytest.mark.thorough
@pytest.mark.parametrize("direction", [(0, 0, 1), (1e-30, 0, 1), (3e-4, -2e-4, 1), (0.09, 0.05, 1)])
def test_gradients_near_the_axis_are_those_of_the_reference(direction, weights):
    """On the axis, where the angle's quotients are 0/0, and on both sides of the switch from their series."""
    scene = scene_around(np.float32, 1) | {"means": 2 * np.float32(direction)[None]}
    slopes = drawn(scene, np.float32(weights))[1]
    with jax.enable_x64(True):
        near = {name: np.float64(value) for name, value in scene.items()}
        near["means"][:, 0] += 1e-9  # the reference is not defined on the axis
        exact = expected(near, weights)[1]
    for name, slope in exact.items():
        if np.abs(slope).max() > 1e-12:  # on the axis the lens has no gradient
            # The gradient of K sums terms fifty times as large: 1.5e-4 to 2.5e-4, as processors order them.
            assert relative_error(np.asarray(slopes[name]), slope) < (5e-4 if name == "Ks" else 2e-4), name
        else:
            assert np.abs(slopes[name]).max() <= 1e-12, name


@pytest.mark.thorough
@pytest.mark.parametrize("widest", [2.5, 3.1])
def test_what_lies_behind_or_beyond_the_fold_is_not_seen(widest, weights):
    """A lens whose polynomial folds back at 1 radian shows nothing beyond it, and no NaN from behind."""
    scene = scene_around(np.float32, widest=widest)
    scene["fisheye"] = np.float32([[-1 / 3, 0, 0, 0]])
    (_, (_, meta)), slopes = drawn(scene, np.float32(weights))
    means = scene["means"]
    angles = np.arctan2(np.linalg.norm(means[:, :2], axis=1), means[:, 2])
    seen = np.asarray(meta.radii[0, :, 0]) > 0
    assert seen.any()
    assert angles[seen].max() < 1.0
    assert seen[angles < 0.9].all()
    for name, slope in slopes.items():
        assert np.isfinite(slope).all(), name
        if name in FIRST:
            assert not np.asarray(slope)[~seen].any(), name


@pytest.mark.thorough
def test_each_camera_has_its_own_lens(weights):
    scene = scene_around(np.float32)
    lenses = np.stack([COEFFS, np.zeros(4)]).astype(np.float32)
    pair = {name: np.repeat(scene[name], 2, axis=0) for name in ("viewmats", "Ks")}
    together = image(scene | pair | {"fisheye": lenses})[0]
    for i in range(2):
        alone = image(scene | {"fisheye": lenses[i : i + 1]})[0]
        # Two programs: XLA may sum in another order (3e-6 of the depth with its default optimisation).
        np.testing.assert_allclose(together[i], alone[0], rtol=1e-5, atol=1e-6)
    assert np.abs(together[0] - together[1]).max() > 0.05


def test_a_lens_that_is_not_finite_sees_nothing_and_counts_it(weights):
    scene = scene_around(np.float32)
    scene["fisheye"] = np.float32([[0.1, np.nan, 0, 0]])
    (_, (values, meta)), slopes = drawn(scene, np.float32(weights))
    assert not np.asarray(values).any()
    assert int(meta.culled[0]) == len(scene["means"])
    assert all(np.isfinite(slope).all() for slope in slopes.values())


@pytest.mark.thorough
def test_a_plan_knows_the_lens():
    scene = scene_around(np.float32)
    geometry = [jnp.asarray(scene[name]) for name in (*FIRST[:4], "viewmats", "Ks")]
    lens = jnp.asarray(scene["fisheye"])
    planned = plan(*geometry, WIDTH, HEIGHT, fisheye=lens, render_mode="RGB+ED", headroom=1.0)
    assert not bool(image(scene, planned)[1].overflow.any())
    assert int(image(scene, planned)[1].needed[0]) <= planned.capacity
