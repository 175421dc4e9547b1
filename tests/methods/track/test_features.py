from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax.methods.track.features
from gsjax.geometry.cameras import Camera, intrinsics, look_at
from gsjax.methods.track import (
    FeatureBatch,
    Pose,
    TrackedScene,
    distill_features,
    feature_distiller,
    first_pose,
    project_features,
    render_features,
)
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.render import plan_render, render

MOVING, COUNT, WIDTH, HEIGHT = 18, 40, 24, 16


@pytest.fixture(scope="module")
def little():
    """Forty Gaussians in front of two cameras: 9 of object 1, 9 of object 2, the rest background. One of
    object 2 and the last five of the background are behind both cameras."""
    rng = np.random.default_rng(0)
    means = rng.uniform([-0.3, -0.2, -0.1], [0.3, 0.2, 0.1], (COUNT, 3))
    means[[17, *range(35, 40)], 1] = -5.0
    quats, scales = rng.normal(size=(COUNT, 4)), rng.uniform(0.02, 0.08, (COUNT, 3))
    colors, opacities = rng.uniform(size=(COUNT, 3)), rng.uniform(0.3, 0.9, COUNT)
    gaussians = gaussians_from_activated(means, quats, scales, opacities, colors)
    labels = np.repeat([1, 2, 0], [9, 9, COUNT - MOVING])
    scene = TrackedScene(gaussians, jnp.zeros((MOVING, 3)), jnp.asarray(labels), (0, 7, 9), MOVING)
    views = [look_at(np.array([x, -1.0, 0.3]), np.zeros(3)) for x in (-0.3, 0.4)]
    K = np.broadcast_to(intrinsics(26.0, WIDTH, HEIGHT), (2, 3, 3))
    cameras = Camera(jnp.asarray(np.array(views), jnp.float32), jnp.asarray(K, jnp.float32), WIDTH, HEIGHT)
    return scene, Frame(jnp.zeros((2, HEIGHT, WIDTH, 3)), None, cameras)


@pytest.fixture(scope="module")
def weights(little):
    """The compositing weights W [pixels, N], by rendering a one-hot feature for each Gaussian."""
    scene, frame = little
    plan, ones = plan_render(scene.gaussians, frame.cameras), jnp.eye(COUNT, 42)
    parts = [
        render(scene.gaussians, frame.cameras, plan, features=ones[:, i : i + 3]) for i in range(0, 42, 3)
    ]
    drawn = np.concatenate([np.asarray(part.features, np.float64) for part in parts], axis=-1)
    return drawn[..., :COUNT].reshape(-1, COUNT)


@pytest.fixture(scope="module")
def maps():
    """Smooth maps, which neither method can fit exactly, but both approximately."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / 8.0
    view = np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)
    return np.stack([view, 0.9 * view + 0.1]).astype(np.float32)


@pytest.mark.thorough
def test_projection_is_the_mean_of_the_pixels_that_show_a_gaussian(little, weights, maps):
    features = project_features(*little, maps)
    seen = weights.sum(0) >= 0.1
    assert 30 < seen.sum() < COUNT
    wanted = (weights.T @ maps.reshape(-1, 3)) / np.maximum(weights.sum(0), 1e-12)[:, None]
    np.testing.assert_allclose(features[seen], wanted[seen], atol=1e-5)


@pytest.mark.thorough
def test_unseen_ones_take_what_the_nearest_of_their_label_has(little, weights, maps):
    scene, frame = little
    features, means = project_features(scene, frame, maps), np.asarray(scene.gaussians.means)
    labels, seen = np.asarray(scene.labels), weights.sum(0) >= 0.1
    assert not seen[17]
    kin = np.flatnonzero((labels == 2) & seen)
    nearest = kin[np.argmin(np.linalg.norm(means[kin] - means[17], axis=1))]
    np.testing.assert_array_equal(features[17], features[nearest])
    alone = eqx.tree_at(lambda s: s.labels, scene, scene.labels.at[17].set(1).at[:9].set(2).at[17].set(1))
    assert not project_features(alone, frame, maps)[17].any()


@pytest.mark.thorough
@pytest.mark.parametrize("ways", [project_features, distill_features])
def test_a_constant_map_gives_that_constant_on_all_gaussians(little, ways):
    constant = np.array([0.3, -2.0, 40.0], np.float32)
    features = ways(*little, np.broadcast_to(constant, (2, HEIGHT, WIDTH, 3)))
    np.testing.assert_allclose(features, np.broadcast_to(constant, (COUNT, 3)), rtol=2e-5)


def test_projection_is_linear_in_the_maps(little, maps):
    other = maps[:, ::-1].copy()
    together = project_features(*little, 2 * maps - 3 * other)
    apart = 2 * project_features(*little, maps) - 3 * project_features(*little, other)
    np.testing.assert_allclose(together, apart, atol=2e-5)


@pytest.mark.thorough
def test_distillation_solves_its_least_squares_problem(little, weights, maps):
    """Against the dense normal equations in float64."""
    damping = 0.05
    prior = project_features(*little, maps).astype(np.float64)
    target = weights.sum(1, keepdims=True) * maps.reshape(-1, 3)
    normal = weights.T @ weights + damping * np.eye(COUNT)
    wanted = np.linalg.solve(normal, weights.T @ target + damping * prior)
    features = distill_features(*little, maps, iterations=60, damping=damping)
    np.testing.assert_allclose(features, wanted, atol=2e-3)


def test_distilled_features_render_closer_to_the_maps_than_projected_ones(little, maps):
    scene, frame = little

    def error(features):
        drawn, alphas = render_features(scene, first_pose(scene), jnp.asarray(features), frame.cameras)
        return float(jnp.mean(jnp.square(alphas[..., None] * (drawn - maps))))

    projected, distilled = error(project_features(*little, maps)), error(distill_features(*little, maps))
    assert distilled < 0.7 * projected
    assert error(distill_features(*little, maps, iterations=40)) == pytest.approx(distilled, rel=0.02)
    assert projected < 0.2 * float(np.square(maps).mean())


def test_pixels_that_are_not_finite_do_not_count(little, maps):
    broken = maps.copy()
    broken[0, 3:6, 4:9, 1] = np.nan
    patched = maps.copy()
    patched[0, 3:6, 4:9] = 77.0
    for ways in (project_features, distill_features):
        features = ways(*little, broken)
        assert np.isfinite(features).all()
        assert np.abs(features).max() < 5
        assert np.abs(ways(*little, patched)).max() > 5


@pytest.mark.thorough
def test_many_channels_are_done_a_few_at_a_time(little, maps, monkeypatch):
    monkeypatch.setattr(gsjax.methods.track.features, "_CHANNELS", 3)
    mixed = (maps @ np.random.default_rng(1).normal(size=(3, 7))).astype(np.float32)
    many = distill_features(*little, mixed)
    assert many.shape == (COUNT, 7)
    np.testing.assert_allclose(many[:, 4:7], distill_features(*little, mixed[..., 4:7]), atol=2e-4)


@pytest.mark.thorough
def test_the_transpose_is_exact_and_the_step_is_pure(little, maps):
    scene, frame = little
    plan = plan_render(scene.gaussians, frame.cameras)
    rng = np.random.default_rng(2)

    def draw(features):
        return render(scene.gaussians, frame.cameras, plan, features=features).features

    features = jnp.asarray(rng.normal(size=(COUNT, 3)), jnp.float32)
    drawn, transpose = jax.vjp(draw, features)
    inner = float(jnp.vdot(features, transpose(jnp.asarray(maps))[0]))
    assert float(jnp.vdot(drawn, maps)) == pytest.approx(inner, rel=1e-4)

    ones = jnp.ones(maps.shape[:3])
    weights = transpose(jnp.ones_like(maps))[0][:, 0]
    batch = FeatureBatch(
        scene.gaussians, frame.cameras, jnp.asarray(maps), ones, features, weights, jnp.float32(0.1), plan
    )
    step = feature_distiller()
    blank = step.init(features)
    still, state, info = step.update(features, blank, batch, step=0, key=None)
    np.testing.assert_array_equal(still, features)  # the first step only computes the residual
    assert info["loss"] == state.energy.sum() > 0
    first, second, info = step.update(features, state, batch, step=1, key=None)
    assert not info["skipped"]
    small = batch._replace(plan=replace(plan, capacity=2))
    kept, _, info = step.update(features, state, small, step=1, key=None)
    assert info["overflow"] & info["skipped"]
    assert info["needed"] > 2
    np.testing.assert_array_equal(kept, features)
    assert (second.energy < state.energy).all()
    poisoned = state._replace(direction=state.direction.at[0, 0].set(jnp.nan))
    kept, _, info = step.update(features, poisoned, batch, step=0, key=None)
    assert info["skipped"]
    np.testing.assert_array_equal(kept, features)
    assert not np.array_equal(first, features)


def test_features_ride_along(little):
    """An object that moves together with the cameras shows the same features."""
    scene, frame = little
    shift = jnp.array([0.4, 0.1, -0.2])
    features = jax.nn.one_hot(scene.labels, 3)
    pose, cameras = first_pose(scene), frame.cameras
    only = eqx.tree_at(
        lambda s: s.gaussians.logit_opacities, scene, scene.gaussians.logit_opacities.at[MOVING:].set(-20.0)
    )
    still, alphas = render_features(only, pose, features, cameras)
    moved = cameras.viewmat.at[:, :3, 3].add(-cameras.viewmat[:, :3, :3] @ shift)
    cameras = Camera(moved, cameras.K, WIDTH, HEIGHT)
    later, _ = render_features(only, Pose(pose.means + shift, pose.quats), features, cameras)
    np.testing.assert_allclose(later, still, atol=2e-4)
    # A weighted mean of one-hot vectors sums to 1, whatever the opacity.
    shown = np.asarray(alphas) > 0.01
    assert 0 < shown.sum() < shown.size
    np.testing.assert_allclose(np.asarray(still)[shown].sum(-1), 1.0, atol=1e-3)


@pytest.mark.parametrize("shape", [(2, HEIGHT, WIDTH), (1, HEIGHT, WIDTH, 3), (2, HEIGHT, WIDTH + 1, 3)])
def test_maps_of_another_size_are_refused(little, shape):
    with pytest.raises(ValueError, match=r"maps: expected shape \[2, 16, 24, 'D'\] to match images"):
        project_features(*little, np.zeros(shape, np.float32))


def test_negative_damping_is_refused(little, maps):
    with pytest.raises(ValueError, match="damping: expected 0 or more, found -1"):
        distill_features(*little, maps, damping=-1.0)
