"""Rendering a scene in cameras: equal to calling the public rasterizer directly."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax
from gsjax.geometry.cameras import Camera, intrinsics, look_at, resized
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render, render_with_room

WIDTH, HEIGHT = 40, 28


def make_scene(seed: int = 0, count: int = 30):
    rng = np.random.default_rng(seed)
    return gaussians_from_activated(
        rng.uniform(-0.3, 0.3, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.02, 0.08, (count, 3)),
        rng.uniform(0.2, 0.9, count),
        rng.uniform(size=(count, 3)),
    )


def make_cameras(count: int = 2) -> Camera:
    eyes = np.array([[1.0, 0.2, 0.4], [0.3, -1.0, 0.5], [-0.8, 0.6, 0.3]])[:count]
    K = jnp.asarray(intrinsics(1.2 * WIDTH, WIDTH, HEIGHT), jnp.float32)
    views = [jnp.asarray(look_at(eye, np.zeros(3)), jnp.float32) for eye in eyes]
    return Camera(jnp.stack(views), jnp.stack([K] * count), WIDTH, HEIGHT)


def one_camera(cameras: Camera, c: int) -> Camera:
    return Camera(cameras.viewmat[c : c + 1], cameras.K[c : c + 1], cameras.width, cameras.height)


@pytest.fixture(scope="module")
def scene():
    return make_scene()


@pytest.fixture(scope="module")
def cameras():
    return make_cameras()


@pytest.mark.thorough
def test_it_is_the_rasterizer_on_activated_values(scene, cameras):
    features = jnp.asarray(np.random.default_rng(1).normal(size=(scene.num, 5)), jnp.float32)
    backgrounds = jnp.array([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
    plan = plan_render(scene, cameras)
    ours = render(scene, cameras, plan, features=features, backgrounds=backgrounds)
    images, alphas, meta = gsjax.rasterization(
        scene.means,
        scene.quats,
        scene.scales,
        scene.opacities,
        scene.sh,
        cameras.viewmat,
        cameras.K,
        WIDTH,
        HEIGHT,
        sh_degree=0,
        render_mode="RGB+ED",
        features=features,
        backgrounds=backgrounds,
    )
    np.testing.assert_allclose(ours.colors, images[..., :3], atol=1e-6)
    np.testing.assert_allclose(ours.depths, images[..., 3], atol=1e-5)
    np.testing.assert_allclose(ours.alphas, alphas[..., 0], atol=1e-6)
    np.testing.assert_allclose(ours.features, meta.features, atol=1e-5)
    assert ours.features.shape == (2, HEIGHT, WIDTH, 5)
    assert float(ours.alphas.max()) > 0.5


@pytest.mark.thorough
def test_the_scenes_own_features_are_taken_unless_others_are_given(scene, cameras):
    assert render(scene, cameras).features is None
    ones = jnp.ones((scene.num, 2))
    own = eqx.tree_at(lambda g: g.features, scene, ones, is_leaf=lambda x: x is None)
    drawn = render(own, cameras)
    np.testing.assert_allclose(drawn.features[..., 0], drawn.alphas, atol=1e-5)
    twice = render(own, cameras, features=2 * ones)
    np.testing.assert_allclose(twice.features, 2 * drawn.features, atol=1e-5)


@pytest.mark.thorough
def test_visibility_gives_each_camera_its_own_opacities(scene, cameras):
    visibility = jnp.asarray(np.random.default_rng(2).uniform(size=(2, scene.num)), jnp.float32)
    visibility = visibility.at[0, :10].set(0.0)
    roi = jnp.ones((2, HEIGHT, WIDTH), bool)
    backgrounds = jnp.array([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
    plan = plan_render(scene, cameras)
    together = render(scene, cameras, plan, visibility=visibility, roi=roi, backgrounds=backgrounds)
    for c in range(2):
        logits = jax.scipy.special.logit(scene.opacities * visibility[c])
        own = eqx.tree_at(lambda g: g.logit_opacities, scene, logits)
        alone = render(own, one_camera(cameras, c), plan, backgrounds=backgrounds[c : c + 1])
        np.testing.assert_allclose(together.colors[c], alone.colors[0], atol=2e-6)
        expected = (
            alone.depths[0] * alone.alphas[0]
        )  # not divided by alpha, since rounding errors grow where alpha is small
        np.testing.assert_allclose(together.depths[c] * together.alphas[c], expected, atol=3e-6)
        np.testing.assert_allclose(together.alphas[c], alone.alphas[0], atol=2e-6)


@pytest.mark.thorough
def test_full_visibility_changes_nothing(scene, cameras):
    plan = plan_render(scene, cameras)
    plain, factored = render(scene, cameras, plan), render(scene, cameras, plan, visibility=jnp.ones((2, 30)))
    np.testing.assert_allclose(factored.colors, plain.colors, atol=1e-6)
    np.testing.assert_array_equal(factored.meta.radii, plain.meta.radii)
    assert factored.meta.overflow.shape == plain.meta.overflow.shape


@pytest.mark.thorough
def test_gradients_reach_the_scene_the_cameras_and_the_visibility(scene, cameras):
    plan = plan_render(scene, cameras)

    def loss(scene, viewmat, visibility):
        views = Camera(viewmat, cameras.K, WIDTH, HEIGHT)
        drawn = render(scene, views, plan, visibility=visibility)
        return drawn.colors.sum() + 0.1 * drawn.depths.sum()

    visibility = jnp.full((2, scene.num), 0.8)
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(scene, cameras.viewmat, visibility)
    for gradient in jax.tree.leaves(gradients):
        assert jnp.isfinite(gradient).all()
        assert jnp.abs(gradient).max() > 0


@pytest.mark.thorough
def test_a_region_of_interest_leaves_the_rest_alone(scene, cameras):
    roi = jnp.zeros((2, HEIGHT, WIDTH), bool).at[:, :16, :16].set(True)
    plan = plan_render(scene, cameras)
    whole, part = render(scene, cameras, plan), render(scene, cameras, plan, roi=roi)
    np.testing.assert_allclose(part.colors[:, :16, :16], whole.colors[:, :16, :16], atol=1e-6)
    assert float(jnp.abs(part.alphas[:, 16:, 16:]).max()) == 0


@pytest.mark.thorough
def test_a_plan_holds_its_scene_and_takes_options(scene, cameras):
    plan = plan_render(scene, cameras, headroom=2.0, rasterize_mode="antialiased")
    assert plan.rasterize_mode == "antialiased"
    assert plan.render_mode == "RGB+ED"
    drawn = render(scene, cameras, plan)
    assert not drawn.meta.overflow.any()
    assert int(drawn.meta.needed.max()) <= plan.capacity


def test_under_a_trace_a_plan_is_required(scene, cameras):
    with pytest.raises(ValueError, match="plan"):
        jax.jit(lambda g: render(g, cameras).colors)(scene)


@pytest.mark.thorough
def test_a_plan_is_made_kept_and_grown_as_needed(scene, cameras):
    wanted = render(scene, cameras).colors
    drawn, plan = render_with_room(scene, cameras)
    np.testing.assert_array_equal(drawn.colors, wanted)
    assert render_with_room(scene, cameras, plan)[1] is plan
    drawn, grown = render_with_room(scene, cameras, replace(plan, capacity=16))
    np.testing.assert_array_equal(drawn.colors, wanted)
    assert grown.capacity >= int(drawn.meta.needed.max())
    bare = eqx.tree_at(
        lambda g: g.shN, scene, jnp.zeros((scene.num, 3, 3)), is_leaf=lambda leaf: leaf is None
    )
    assert render_with_room(bare, cameras, plan)[1].sh_degree == 1  # another degree requires another plan


@pytest.mark.thorough
def test_nothing_before_the_cameras_near_plane_is_drawn():
    """A plan takes the near plane from the cameras that it is made for, and so does a call without one."""
    means = jnp.array([[0.0, 0.0, 0.3], [0.0, 0.0, 2.0]])  # the first is right in front of the camera
    scene = gaussians_from_activated(
        means, np.tile([1.0, 0, 0, 0], (2, 1)), np.full((2, 3), 0.2), np.full(2, 0.99), np.eye(3)[:2]
    )
    viewmat, K = jnp.eye(4)[None], jnp.array([[[20.0, 0, 8], [0, 20.0, 8], [0, 0, 1]]])
    for near, color in ((0.01, 0), (0.5, 1)):
        camera = Camera(viewmat, K, 16, 16, near)
        for plan in (plan_render(scene, camera), None):
            drawn = render(scene, camera, plan)
            assert int(drawn.colors[0, 8, 8].argmax()) == color
        assert resized(camera, 0.5, 8, 8).near == near
