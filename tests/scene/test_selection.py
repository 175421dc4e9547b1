"""Parts of a scene removed, hidden, tinted or shifted: the selected Gaussians change, and no others."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.spherical_harmonics import SH_C0, rgb_to_sh0
from gsjax.scene.gaussians import gaussians_from_activated
from gsjax.scene.selection import hidden, only, shifted, tinted, without


@pytest.fixture(params=[None, 3])
def scene(request):
    random = np.random.default_rng(0)
    shN = None if request.param is None else random.normal(size=(20, request.param, 3))
    return gaussians_from_activated(
        random.normal(size=(20, 3)),
        random.normal(size=(20, 4)),
        np.full((20, 3), 0.1),
        np.full(20, 0.8),
        random.uniform(0.2, 0.8, size=(20, 3)),
        shN=shN,
    )


SELECTED = jnp.arange(20) < 7


def test_without_is_the_others_in_their_order(scene):
    rest = without(scene, SELECTED)
    np.testing.assert_array_equal(rest.means, scene.means[7:])


def test_only_and_without_share_the_scene(scene):
    np.testing.assert_array_equal(only(scene, SELECTED).means, scene.means[:7])
    np.testing.assert_array_equal(only(scene, np.arange(20) % 2 == 1).sh0, scene.sh0[1::2])
    assert only(scene, SELECTED).shN is None or only(scene, SELECTED).shN.shape == (7, 3, 3)


def test_hidden_keeps_the_number_and_cannot_be_seen(scene):
    found = hidden(scene, SELECTED)
    np.testing.assert_array_equal(found.means, scene.means)
    np.testing.assert_array_equal(found.opacities[7:], scene.opacities[7:])
    assert (np.asarray(found.opacities)[:7] < 1 / 255).all()


def test_shifted_moves_the_selected_alone(scene):
    moved = shifted(scene, SELECTED, jnp.array([0.0, 1.0, -2.0]))
    gone = np.asarray(moved.means - scene.means)
    np.testing.assert_allclose(gone[:7], np.tile([0, 1, -2], (7, 1)), atol=1e-6)
    assert not gone[7:].any()


def test_tinted_has_the_colour_on_average_and_keeps_shades(scene):
    found = tinted(scene, SELECTED, jnp.array([0.1, 0.5, 0.2]))
    np.testing.assert_array_equal(found.sh0[7:], scene.sh0[7:])
    rgb = 0.5 + SH_C0 * np.asarray(found.sh0)[:7, 0]
    np.testing.assert_allclose(rgb.mean(0), [0.1, 0.5, 0.2], atol=0.03)  # where nothing is clipped
    before = (0.5 + SH_C0 * np.asarray(scene.sh0)[:7, 0]) @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_array_equal(np.argsort(rgb[:, 1]), np.argsort(before))
    if scene.shN is not None:
        assert found.shN is not None
        assert not np.asarray(found.shN)[:7].any()
        np.testing.assert_array_equal(found.shN[7:], scene.shN[7:])


@pytest.mark.parametrize("dark", [0.0, 0.004])
def test_black_objects_are_tinted_too(scene, dark):
    """The shades of an almost black object are noise and are not kept."""
    random = np.random.default_rng(1)
    black = rgb_to_sh0(jnp.asarray(random.uniform(0, 1, (20, 3)) * dark))[:, None]
    found = tinted(eqx.tree_at(lambda g: g.sh0, scene, black), SELECTED, jnp.array([0.1, 0.9, 0.2]))
    rgb = 0.5 + SH_C0 * np.asarray(found.sh0)[:7, 0]
    np.testing.assert_allclose(rgb, np.tile([0.1, 0.9, 0.2], (7, 1)), atol=1e-5)


def test_nothing_selected_is_the_scene(scene):
    nothing = jnp.zeros(20, bool)
    np.testing.assert_array_equal(tinted(scene, nothing, jnp.ones(3)).sh0, scene.sh0)
    assert without(scene, nothing).num == 20
