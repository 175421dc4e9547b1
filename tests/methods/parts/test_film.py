"""Films of several layers: copies of parts, parts of other runs, and no Gaussians that are never visible."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsjax.geometry.rotations import quats_to_matrices
from gsjax.methods.parts import edits
from gsjax.methods.parts.film import Layer, composite, film_gaussians, placed, trimmed
from gsjax.methods.parts.trajectory import gaussians_at, moment
from gsjax.scene.gaussians import concatenate
from tests.methods.parts.made_up_parts import STEP, assert_same, scene_of, trajectory

seeds = st.integers(0, 10_000)
drawn = jax.jit(film_gaussians, static_argnames="blend")
matrices = jax.jit(quats_to_matrices)


def layer_of(seed, parts=4, num=7, moments=9):
    return Layer(scene_of(seed, num, parts), trajectory(seed, moments, parts))


@pytest.mark.thorough
def test_a_film_is_its_layers_one_after_the_other():
    film = (layer_of(0), layer_of(1, parts=2, num=5))
    expected = concatenate([gaussians_at(one.scene, moment(one.trajectory, 3)) for one in film])
    assert_same(film_gaussians(film, 3), expected)
    assert_same(drawn(film, jnp.asarray(3)), expected, atol=2e-5)


def test_layers_of_different_lengths_are_refused():
    with pytest.raises(
        ValueError, match=r"film: expected layers with the same times, found \[8, 9\] moments"
    ):
        film_gaussians((layer_of(0), layer_of(1, moments=8)), 0)


class TestTrimmed:
    def test_leaves_out_what_is_never_seen_and_nothing_else(self):
        layer = layer_of(0, num=60)
        only = Layer(layer.scene, edits.ghost(layer.trajectory, [2]))
        hidden = Layer(layer.scene, edits.fade(layer.trajectory, range(4)))
        film = trimmed((only, hidden, layer))  # nothing is left of the second
        assert len(film) == 2
        weights = np.asarray(layer.scene.weights)[:, 2]
        peak = np.asarray(layer.scene.gaussians.opacities) * weights
        assert 0 < (peak < 1 / 255).sum() < 60
        np.testing.assert_array_equal(np.asarray(film[0].scene.weights)[:, 2], weights[peak >= 1 / 255])
        assert_same(film[1], layer)

    @pytest.mark.thorough
    @given(seeds)
    def test_what_is_left_is_drawn_as_it_was(self, seed):
        layer = layer_of(seed)
        only = Layer(layer.scene, edits.ghost(layer.trajectory, [1]))
        before, after = jax.device_get((drawn((only,), 4), drawn(trimmed((only,)), 4)))
        visible = before.opacities >= 1 / 255
        rows = [
            np.concatenate([g.means, g.quats, g.scales, g.opacities[:, None]], axis=1).round(4)
            for g in (before, after)
        ]
        kept = (rows[1][:, None] == rows[0][visible][None]).all(-1)
        assert (kept.sum(0) == 1).all()

    def test_a_faint_part_keeps_its_gaussians(self):
        """So that dragging an opacity slider causes no recompilation."""
        layer = layer_of(0, num=60)
        sizes = {
            trimmed((Layer(layer.scene, edits.ghost(layer.trajectory, [1], faint)),))[0].scene.gaussians.num
            for faint in (0.01, 0.5, 1.0)
        }
        assert len(sizes) == 1

    def test_the_first_layer_stays_first_even_if_nothing_of_it_is_left(self):
        layer = layer_of(0)
        hidden = Layer(layer.scene, edits.fade(layer.trajectory, range(4)))
        film = trimmed((hidden, hidden, layer))
        assert [one.scene.gaussians.num for one in film] == [0, 7]
        assert_same(film_gaussians(film, 2), film_gaussians((layer,), 2))

    def test_a_film_without_anything_to_see_is_still_one(self):
        layer = layer_of(0)
        film = trimmed((Layer(layer.scene, edits.fade(layer.trajectory, range(4))),))
        assert (film_gaussians(film, 0).opacities < 1e-6).all()


class TestPlaced:
    @pytest.mark.thorough
    @pytest.mark.usefixtures("x64")
    @pytest.mark.parametrize("blend", ["quaternion", "dual"])
    @given(seed=seeds)
    def test_the_whole_of_it_goes_elsewhere_at_every_moment(self, blend, seed):
        layer, rng = layer_of(seed), np.random.default_rng(seed)
        turn, shift, about, factor = *rng.normal(size=(3, 3)), rng.uniform(0.3, 3.0)
        there = placed(layer, jnp.asarray(turn), jnp.asarray(shift), factor, jnp.asarray(about))
        before, after = jax.device_get([drawn((one,), 5, blend=blend) for one in (layer, there)])
        R = Rotation.from_rotvec(turn).as_matrix()
        expected = about + shift + factor * (before.means - about) @ R.T
        np.testing.assert_allclose(after.means, expected, atol=1e-6)
        turns = [np.asarray(matrices(one.quats)) for one in (before, after)]
        np.testing.assert_allclose(turns[1], R @ turns[0], atol=1e-6)
        np.testing.assert_allclose(after.scales, factor * np.asarray(before.scales), rtol=1e-6)
        np.testing.assert_allclose(after.opacities, before.opacities, atol=1e-9)

    def test_nowhere_else_is_nothing(self):
        layer = layer_of(3)
        there = placed(layer, jnp.zeros(3), jnp.zeros(3))
        assert_same(film_gaussians((there,), 2), film_gaussians((layer,), 2), atol=1e-5)

    def test_a_size_of_nothing_is_refused(self):
        with pytest.raises(ValueError, match="factor: expected more than 0, found 0"):
            placed(layer_of(0), jnp.zeros(3), jnp.zeros(3), 0.0)


def test_composite_shows_only_these_parts_at_the_times_of_the_film():
    film = (layer_of(0),)
    other = layer_of(1, parts=2, moments=4)
    both = composite(film, other, [1])
    assert both[0] is film[0]
    assert_same(both[1].trajectory.times, film[0].trajectory.times)
    assert not np.asarray(both[1].trajectory.opacities)[:, 0].any()
    late = np.asarray(both[1].trajectory.poses.translations)[4:]  # after its end it stands still
    assert_same(late, np.broadcast_to(np.asarray(other.trajectory.poses.translations)[3], late.shape))
    assert film_gaussians(both, 5).num == 14


@pytest.mark.thorough
def test_an_echo_of_the_film_is_the_part_as_it_was_before():
    layer = layer_of(2)
    layer = eqx.tree_at(
        lambda one: one.scene.weights, layer, jnp.asarray(np.eye(4, dtype=np.float32)[np.arange(7) % 4])
    )
    film = (layer, Layer(layer.scene, edits.echo(layer.trajectory, [1], 2 * STEP, 0.5)))
    film = trimmed(film)
    one = jax.device_get(film_gaussians(film, 6))
    then = jax.device_get(gaussians_at(layer.scene, moment(layer.trajectory, 4)))
    rows = np.array([1, 5])  # of part 1
    np.testing.assert_array_equal(one.means[7:], then.means[rows])
    np.testing.assert_allclose(one.opacities[7:], then.opacities[rows] / 2, rtol=1e-5)
