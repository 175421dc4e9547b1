"""Scenes of parts at a moment: opacities, sizes and poses are those of the moment, all else is unchanged."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.test_util import check_grads

from gsjax.methods.parts.trajectory import (
    Moment,
    PartScene,
    Trajectory,
    gaussians_at,
    moment,
    still,
    trajectory_of,
)
from gsjax.scene.handles import HandlePose, at_rest, skin
from tests.methods.parts.made_up_parts import assert_same, moment_of, scene_of, whole

seeds = st.integers(0, 10_000)


def made_up(seed, num=7):
    return scene_of(seed, num), moment_of(seed + 1)


def unedited(pose):
    ones = jnp.ones(len(pose.quats))
    return Moment(pose, ones, ones)


@given(seeds)
def test_where_nothing_is_edited_it_is_skinning_to_the_bit(seed):
    """Whatever the rounding of the weights, also for opaque and almost invisible Gaussians."""
    scene, now = made_up(seed)
    logits = jnp.array([-30.0, -9.0, -1.0, 0.0, 2.0, 17.0, 39.0])
    scene = eqx.tree_at(lambda s: s.gaussians.logit_opacities, scene, logits)
    expected = skin(scene.gaussians, scene.weights, scene.centers, now.pose)
    found = gaussians_at(scene, unedited(now.pose))
    assert_same(found, expected)


def test_no_product_is_in_reduced_precision():
    program = jax.jit(gaussians_at).lower(*made_up(0)).as_text()
    assert "HIGHEST" in program
    assert "DEFAULT" not in program


@pytest.mark.usefixtures("x64")
@given(seeds)
def test_at_rest_the_scene_is_canonical(seed):
    scene, _ = made_up(seed)
    found = gaussians_at(scene, unedited(at_rest(3)))
    np.testing.assert_allclose(found.means, scene.gaussians.means, atol=1e-12)
    assert found.sh0 is scene.gaussians.sh0


@pytest.mark.usefixtures("x64")
@given(seeds, st.integers(0, 2))
def test_one_part_is_scaled_about_its_handle_and_then_moved(seed, part):
    scene, now = made_up(seed)
    scene = whole(scene, part)
    found = gaussians_at(scene, now)
    size, center = now.scales[part], scene.centers[part]
    larger = eqx.tree_at(lambda g: g.means, scene.gaussians, center + size * (scene.gaussians.means - center))
    expected = skin(larger, scene.weights, scene.centers, now.pose)
    np.testing.assert_allclose(found.means, expected.means, atol=1e-9)
    np.testing.assert_allclose(found.scales, size * scene.gaussians.scales, rtol=1e-9)


@pytest.mark.usefixtures("x64")
@given(seeds)
def test_between_parts_sizes_places_and_opacities_are_the_weights_mean(seed):
    scene, now = made_up(seed)
    now = now._replace(pose=at_rest(3))
    found = gaussians_at(scene, now)
    each = [gaussians_at(whole(scene, p), now) for p in range(3)]
    for of in (lambda g: g.means, lambda g: g.scales, lambda g: g.opacities):
        mean = jnp.einsum("np,pn...->n...", scene.weights, jnp.stack([of(one) for one in each]))
        np.testing.assert_allclose(of(found), mean, atol=1e-9)


def test_what_has_opacity_0_is_hidden_and_what_has_1_is_as_it_was():
    scene, now = made_up(2)
    weights = jax.nn.one_hot(jnp.array([0, 1, 2, 1, 2, 0, 1]), 3)
    logits = jnp.array([3.0, 60.0, 3.0, 3.0, -3.0, 3.0, 3.0])
    scene = PartScene(
        eqx.tree_at(lambda g: g.logit_opacities, scene.gaussians, logits), weights, scene.centers
    )
    found = gaussians_at(scene, now._replace(opacities=jnp.array([1.0, 0.0, 0.5])))
    assert (found.opacities[np.array([1, 3, 6])] < 1e-6).all()
    np.testing.assert_array_equal(found.logit_opacities[np.array([0, 5])], 3.0)
    both = np.array([2, 4])
    np.testing.assert_allclose(found.opacities[both], scene.gaussians.opacities[both] / 2, rtol=1e-5)


def test_a_batch_of_moments_is_a_loop_also_under_jit():
    scene, _ = made_up(4)
    nows = [made_up(seed)[1] for seed in range(3)]
    film = Trajectory(
        jnp.arange(3.0),
        *(jax.tree.map(lambda *rows: jnp.stack(rows), *column) for column in zip(*nows, strict=True)),
    )
    batch = jax.jit(jax.vmap(lambda t: gaussians_at(scene, moment(film, t))))(jnp.arange(3))
    for t, now in enumerate(nows):
        assert_same(jax.tree.map(lambda leaf, t=t: leaf[t], batch), gaussians_at(scene, now), atol=2e-5)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(2))
def test_derivatives(seed):
    scene, now = made_up(seed, num=3)

    def seen(opacities, scales, translations, centers):
        opacities, scales, translations, centers = map(
            jnp.asarray, (opacities, scales, translations, centers)
        )
        pose = HandlePose(now.pose.quats, translations)
        there = eqx.tree_at(lambda s: s.centers, scene, centers)
        found = gaussians_at(there, Moment(pose, opacities, scales))
        return found.means, found.log_scales, found.opacities

    check_grads(
        seen, (now.opacities, now.scales, now.pose.translations, scene.centers), order=1, modes=["fwd", "rev"]
    )


@pytest.mark.parametrize("factor", [0.0, 1.0])
def test_gradients_are_finite_where_parts_are_hidden_or_wholly_shown(factor):
    scene, now = made_up(5)
    scene = eqx.tree_at(lambda s: s.gaussians.logit_opacities, scene, jnp.linspace(-90.0, 90.0, 7))

    def total(moment, scene):
        found = gaussians_at(scene, moment)
        return sum(leaf.sum() for leaf in (found.means, found.quats, found.log_scales, found.opacities))

    slopes = jax.jit(jax.grad(total, argnums=(0, 1)))(now._replace(opacities=jnp.full(3, factor)), scene)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_a_trajectory_begins_with_all_parts_shown_and_none_larger():
    times = jnp.arange(4.0)
    nothing = still(3, times)
    assert nothing.poses.quats.shape == (4, 3, 4)
    for t in range(4):
        now = moment(nothing, t)
        assert (now.opacities == 1).all()
        assert (now.scales == 1).all()
        assert_same(now.pose, at_rest(3))
    assert_same(trajectory_of(times, nothing.poses), nothing)
