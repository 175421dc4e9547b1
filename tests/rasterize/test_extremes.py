"""Inputs at the limits of floats: images and gradients are finite and equal to float64 where that is
defined, or there is an error.

Poison in every input: test_poison.py and `python -m benchmarks.fuzz`. Figures: docs/numerics.md.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.scenes import relative_error
from gsjax.io.ply import read_ply, write_ply
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization
from gsjax.scene.gaussians import Gaussians, gaussians_from_activated
from tests.rasterize.front import (
    GAUSSIANS,
    TRAINED,
    cotangent,
    drawn,
    gradient_error,
    plan_for,
    reference,
    scene_before,
)


def errors(scene, weights=None, plan=None, certain=None):
    """Returns the errors of float32 against float64 (image, worst gradient), and meta.

    Errors are relative to the array's largest value, and infinite where anything is not finite; a gradient
    below 1e-17 everywhere counts as equal.
    """
    plan = plan_for() if plan is None else plan
    weights = cotangent(plan.width, plan.height) if weights is None else weights
    exact = {k: np.float64(v) for k, v in scene.items()}
    with jax.enable_x64(True):
        if certain is None:
            certain = ~np.asarray(reference(exact, np.zeros_like(weights, np.float64), plan)[2])[..., None]
        weights = np.where(certain, weights, np.float32(0))
        want, slope, _ = jax.tree.map(np.asarray, reference(exact, np.float64(weights), plan))
    got, gradient, meta = drawn(scene, weights, plan)
    return relative_error(got, want, certain), gradient_error(gradient, slope), meta


def changed(**changes):
    """Returns a function that sets entries of a scene, given as name=(index, value)."""

    def change(scene):
        scene = {k: v.copy() for k, v in scene.items()}
        for name, (index, value) in changes.items():
            scene[name][index] = value
        return scene

    return change


def with_focal(focal, scene):
    """The same picture with another focal length: the Gaussians move closer to the axis in proportion."""
    scene = changed(Ks=((0, [0, 1], [0, 1]), focal))(scene)
    scene["means"][:, :2] *= np.float32(30 / focal)
    scene["scales"] *= np.float32(30 / focal)
    return scene


FULL = {"means": (0, (0, 0, 1.5)), "scales": (0, 1e3)}
# Cases that can be drawn, with the largest allowed errors of image and gradients, relative to their maximum.
DRAWN = {
    "one that fills the frame": (changed(**FULL), 1e-5, 3e-4),
    "a hair in front of the near plane": (changed(means=(0, (0, 0, 0.0100001))), 1e-4, 1e-3),
    "a camera inside a Gaussian": (changed(means=(0, (0.02, 0.01, 0.05)), scales=(0, 0.5)), 1e-4, 1e-3),
    "all of scale 1e-12": (changed(scales=(slice(None), 1e-12)), 1e-5, 3e-4),
    "one of scale 1e-12": (changed(scales=(0, 1e-12)), 1e-5, 3e-4),
    "one axis 1e-8 of the others": (changed(scales=((slice(None), 0), 1e-9)), 1e-5, 3e-4),
    "two axes 1e-8 of the third": (changed(scales=((slice(None), [0, 1]), 1e-9)), 1e-5, 1e-3),
    "quaternions of length 1e-5": (lambda s: s | {"quats": s["quats"] * np.float32(1e-5)}, 1e-5, 3e-4),
    "quaternions of length 1e15": (lambda s: s | {"quats": s["quats"] * np.float32(1e15)}, 1e-5, 3e-4),
    "a denormal in each quaternion": (changed(quats=((slice(None), 1), 1e-42)), 1e-5, 3e-4),
    "opacity 1": (changed(opacities=(slice(None), 1.0)), 1e-5, 3e-4),
    "opacity 0": (changed(opacities=(slice(6), 0.0)), 1e-5, 3e-4),
    "a colour of 1e18": (changed(colors=(0, 1e18)), 1e-5, 3e-4),
    "focal length 1 px": (partial(with_focal, 1.0), 1e-5, 3e-4),
    "focal length 1e5 px": (partial(with_focal, 1e5), 1e-4, 1e-3),
}


@pytest.mark.parametrize("name", DRAWN)
def test_what_can_be_drawn_is_drawn_as_the_reference_draws_it(name):
    change, image_limit, gradient_limit = DRAWN[name]
    image, gradient, meta = errors(change(scene_before()))
    assert image <= image_limit
    assert gradient <= gradient_limit
    assert int(meta.culled[0]) == 0


LEFT_OUT = {
    "at the near plane": (changed(means=(0, (0, 0, 0.01))), 0),
    "behind the near plane": (changed(means=(0, (0, 0, 0.0099))), 0),
    "at the camera": (changed(means=(0, 0.0)), 0),
    "behind the camera": (changed(means=((0, 2), -2.0)), 0),
    "scale 1e12": (changed(scales=(0, 1e12)), 1),
    "a zero quaternion": (changed(quats=(0, 0.0)), 1),
    "a denormal quaternion": (changed(quats=(0, 1e-42)), 1),
    "a colour of NaN": (changed(colors=((0, 1), np.nan)), 1),
    "a colour of infinity": (changed(colors=((0, 1), np.inf)), 1),
    "a colour of 1e38": (changed(colors=((0, 1), 1e38)), 1),
    "opacity 0": (changed(opacities=(0, 0.0)), 0),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_cannot_be_drawn_leaves_the_scene_without_it(name):
    change, culled = LEFT_OUT[name]
    scene = scene_before()
    got, gradient, meta = drawn(change(scene), cotangent(), plan_for())
    want, clean, _ = drawn(changed(opacities=(0, 0.0))(scene), cotangent(), plan_for())
    assert int(meta.culled[0]) == culled
    np.testing.assert_array_equal(got, want)
    for key in TRAINED:
        np.testing.assert_array_equal(gradient[key], clean[key], err_msg=key)
        assert np.isfinite(gradient[key]).all()
    assert not any(np.any(gradient[key][0]) for key in GAUSSIANS)


@pytest.mark.thorough
def test_a_needle_longer_than_float64_can_square_equals_itself_in_float64():
    # Not against the reference, which multiplies out the covariance: 1e24 beside 1e-3 exceeds float64 too.
    scene = changed(scales=((0, 0), 1e12))(scene_before())
    got, gradient, meta = drawn(scene, cotangent(), plan_for())
    with jax.enable_x64(True):
        exact = {k: np.float64(v) for k, v in scene.items()}
        want, slope, _ = jax.tree.map(np.asarray, drawn(exact, np.float64(cotangent()), plan_for()))
    assert int(meta.culled[0]) == 0
    assert relative_error(got, want) < 1e-4
    assert gradient_error(gradient, slope) < 1e-3


def test_none_visible_is_the_background_with_zero_gradients():
    scene = changed(means=((slice(None), 2), -3.0))(scene_before())
    image, gradient, meta = drawn(scene, cotangent(), plan_for())
    np.testing.assert_array_equal(image[..., :3], np.float32(0.3))
    assert not np.any(image[..., 3:])
    assert not any(np.any(gradient[key]) for key in TRAINED if key != "backgrounds")
    assert (int(meta.pairs[0]), int(meta.culled[0])) == (0, 0)


def test_no_gaussians_is_the_background():
    scene = {k: v[:0] if k in GAUSSIANS else v for k, v in scene_before().items()}
    image, gradient, _ = drawn(scene, cotangent(), plan_for())
    np.testing.assert_array_equal(image[..., :3], np.float32(0.3))
    assert all(np.isfinite(gradient[key]).all() for key in TRAINED)


def test_all_at_equal_depth_are_drawn_in_the_order_of_the_input():
    scene = changed(means=((slice(None), 2), 2.0))(scene_before())
    image, gradient, _ = errors(scene, certain=np.ones((17, 33, 1), bool))  # exact ties are not doubtful
    assert image <= 1e-5
    assert gradient <= 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("width", "height"), [(1, 1), pytest.param(1, 4096, marks=pytest.mark.slow), (17, 33)]
)
def test_images_of_any_shape(width, height):
    scene = scene_before(width, height)
    image, gradient, meta = errors(scene, plan=plan_for(width, height))
    assert not bool(meta.overflow[0])
    # At the ends of the tall image y is 68 times z.
    assert image <= 1e-4
    assert gradient <= 1e-3


@pytest.mark.thorough
@pytest.mark.parametrize("num", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_a_tile_with_many_layers_equals_the_reference_on_the_layers_that_light_reaches(num):
    reached = 6_000
    scene = scene_before(16, 16, num=num)
    rng = np.random.default_rng(0)
    scene["means"][:, 2] = np.sort(np.float32(2 + 2 * (np.arange(num) + rng.uniform(0.2, 0.8, num)) / num))
    weights = cotangent(16, 16)
    this = plan_for(16, 16, num)
    front = {k: v[:reached] if k in GAUSSIANS else v for k, v in scene.items()}
    exact = {k: np.float64(v) for k, v in front.items()}
    with jax.enable_x64(True):
        want, slope, doubtful = reference(exact, np.float64(weights), this)
        certain = ~np.asarray(doubtful)[..., None]
        weights = np.where(certain, weights, np.float32(0))
        want, slope, _ = jax.tree.map(np.asarray, reference(exact, np.float64(weights), this))
    assert want[..., 4].min() > 0.999  # nothing shines through
    got, gradient, meta = drawn(scene, weights, this)
    assert not bool(meta.overflow[0])
    assert int(meta.pairs[0]) > num
    assert relative_error(got, want, certain) <= 1e-5
    for key in GAUSSIANS:
        assert relative_error(gradient[key][:reached], slope[key]) <= 1e-3, key
        assert not np.any(gradient[key][reached:])


@pytest.mark.thorough
def test_logits_of_100_and_opacities_of_0_and_1_through_gaussians():
    scene = scene_before()
    activated = gaussians_from_activated(*(scene[name] for name in GAUSSIANS))
    ends = gaussians_from_activated(*(scene[k] for k in GAUSSIANS[:3]), np.arange(12.0) % 2, scene["colors"])
    assert np.isfinite(ends.logit_opacities).all()
    logits = jnp.where(jnp.arange(12) % 2 == 0, 100.0, -100.0)
    both = [dataclasses.replace(activated, logit_opacities=logits), ends]

    @jax.jit
    @jax.grad
    def slope(gaussians: Gaussians):
        camera = (jnp.asarray(scene["viewmats"]), jnp.asarray(scene["Ks"]))
        arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
        this = Plan(33, 17, 4096, sh_degree=0)
        image, alphas, _ = rasterization(*arrays, *camera, 33, 17, plan=this)
        return jnp.vdot(image, cotangent()[None, ..., :3]) + alphas.sum()

    for gaussians in both:
        gradient = slope(gaussians)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        assert np.any(gradient.means[0::2] if gaussians is both[0] else gradient.means[1::2])
        assert not np.any(gradient.means[1::2] if gaussians is both[0] else gradient.means[0::2])


@pytest.mark.thorough
def test_more_than_2_to_the_31_pairs_saturate_and_are_an_error_for_a_plan():
    num = 70_000  # times 32,400 tiles: 2.27e9 pairs
    arrays = {
        "means": np.tile(np.float32([0, 0, 2]), (num, 1)),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (num, 1)),
        "scales": np.full((num, 3), 1e3, np.float32),
        "opacities": np.full(num, 0.9, np.float32),
        "viewmats": np.eye(4, dtype=np.float32)[None],
        "Ks": np.float32([[[1000, 0, 960], [0, 1000, 540], [0, 0, 1]]]),
    }
    arrays = jax.tree.map(jnp.asarray, arrays)
    image, _, meta = rasterization(
        **arrays, colors=jnp.ones((num, 1)), width=1920, height=1080, plan=Plan(1920, 1080, 4096)
    )
    assert bool(meta.overflow[0])
    assert int(meta.needed[0]) == 2**31 - 1
    assert int(meta.pairs[0]) == 0
    assert not np.any(image)
    with pytest.raises(ValueError, match=r"more than 2\^30 tiles of a 1920x1080 image; prune"):
        plan(**arrays, width=1920, height=1080)


@pytest.mark.slow
def test_889536_zero_quaternions_in_one_file(tmp_path):
    # splat-transform #288: one real file contained this many. Both the reader and the rasterizer count them.
    zeros, scene = 889_536, scene_before()
    few = gaussians_from_activated(*(scene[name] for name in GAUSSIANS))
    many = jax.tree.map(lambda a: np.concatenate([a, np.repeat(np.asarray(a)[:1], zeros, axis=0)]), few)
    many.quats[12:] = 0
    write_ply(tmp_path / "zeros.ply", many)
    with pytest.warns(UserWarning, match=f"{zeros} of {zeros + 12} Gaussians cannot be drawn"):
        back, report = read_ply(tmp_path / "zeros.ply")
    assert back.num == 12
    assert str(zeros) in str(report).replace(",", "")
    padded = {
        k: np.concatenate([v, np.repeat(v[:1], zeros, axis=0)]) if k in GAUSSIANS else v
        for k, v in scene.items()
    }
    padded["quats"][12:] = 0
    got, gradient, meta = drawn(padded, cotangent(), plan_for())
    want, clean, _ = drawn(scene, cotangent(), plan_for())
    assert int(meta.culled[0]) == zeros
    np.testing.assert_allclose(got, want, atol=1e-6)
    for key in GAUSSIANS:
        np.testing.assert_allclose(gradient[key][:12], clean[key], rtol=1e-4, atol=1e-4)
        assert not np.any(gradient[key][12:])
