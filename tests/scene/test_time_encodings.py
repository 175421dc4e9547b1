"""Encodings of position and time by planes, sinusoids and voxels: values and gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from gsjax.scene.time_encodings import HexPlane, Sinusoids, init_hexplane, init_voxels, sinusoids, within

BOX = ((-1.0, 0.0, 2.0), (1.0, 0.5, 3.0))


def random_planes(seed=0, resolution=5, times=4, levels=2, channels=3):
    rng = np.random.default_rng(seed)
    sides = [resolution * 2**level for level in range(levels)]
    space = tuple(jnp.asarray(rng.normal(size=(3, side, side, channels))) for side in sides)
    time = tuple(jnp.asarray(rng.normal(size=(3, times, side, channels))) for side in sides)
    return HexPlane(space, time)


def by_hand(planes, place, time):
    """Bilinear interpolation of each plane, and the product of the six, one position at a time in numpy."""

    def between(x, size):
        first = min(int(np.floor(x * (size - 1))), size - 2)
        return first, x * (size - 1) - first

    def on(plane, a, b):
        (i, u), (j, v) = between(a, plane.shape[0]), between(b, plane.shape[1])
        low = (1 - v) * plane[i, j] + v * plane[i, j + 1]
        return (1 - u) * low + u * ((1 - v) * plane[i + 1, j] + v * plane[i + 1, j + 1])

    found = []
    for space, lines in zip(planes.space, planes.time, strict=True):
        space, lines = np.asarray(space), np.asarray(lines)
        value = 1.0
        for plane, (i, j) in zip(space, ((0, 1), (0, 2), (1, 2)), strict=True):
            value = value * on(plane, place[i], place[j])
        for axis in range(3):
            value = value * on(lines[axis], time, place[axis])
        found.append(value)
    return np.concatenate(found)


def test_places_in_a_box():
    inside = within(jnp.array([[0.0, 0.25, 2.5], [-9.0, 9.0, 2.0], [jnp.nan, 0.0, 3.0]]), BOX)
    np.testing.assert_allclose(inside, [[0.5, 0.5, 0.5], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]])


def test_gradients_of_positions_reach_the_surface_and_end_there():
    slope = jax.vmap(jax.grad(lambda x: within(x[None], BOX).sum()))
    found = slope(jnp.array([[-1.0, 0.5, 2.0], [-1.1, 0.6, 1.9], [jnp.nan, 0.25, 2.5]]))
    np.testing.assert_allclose(found, [[0.5, 2, 1], [0, 0, 0], [0, 2, 1]])


@pytest.mark.usefixtures("x64")
class TestHexPlane:
    @pytest.mark.thorough
    def test_is_the_product_of_six_planes(self):
        planes, rng = random_planes(), np.random.default_rng(1)
        places = np.concatenate([rng.uniform(size=(6, 3)), [[0, 0, 0], [1, 1, 1], [0.25, 0.5, 1]]])
        for time in (0.0, 0.4, 1.0):
            found = planes(jnp.asarray(places), jnp.asarray(time))
            np.testing.assert_allclose(found, [by_hand(planes, p, time) for p in places], atol=1e-12)

    def test_beyond_its_ends_the_time_stands_still(self):
        planes, places = random_planes(), jnp.full((1, 3), 0.3)
        np.testing.assert_array_equal(planes(places, jnp.asarray(7.0)), planes(places, jnp.asarray(1.0)))
        np.testing.assert_array_equal(planes(places, jnp.asarray(-7.0)), planes(places, jnp.asarray(0.0)))

    def test_slopes(self):
        planes = random_planes(levels=1)
        places = jnp.asarray(np.random.default_rng(2).uniform(0.05, 0.95, (4, 3)))
        check_grads(jax.jit(lambda p, x, t: p(x, t)), (planes, places, jnp.asarray(0.45)), order=1, rtol=1e-5)

    @pytest.mark.thorough
    def test_vmap_over_times_is_a_loop(self):
        planes, places = random_planes(), jnp.asarray(np.random.default_rng(3).uniform(size=(5, 3)))
        times = jnp.linspace(0.0, 1.0, 3)
        together = jax.vmap(planes, in_axes=(None, 0))(places, times)
        np.testing.assert_allclose(together, [planes(places, t) for t in times], atol=1e-12)

    def test_at_first_nothing_depends_on_the_time(self):
        planes = init_hexplane(jax.random.key(0), 4, 3, 2, 2)
        places = jnp.asarray(np.random.default_rng(4).uniform(size=(5, 3)))
        np.testing.assert_allclose(planes(places, jnp.asarray(0.1)), planes(places, jnp.asarray(0.8)))
        assert planes(places, jnp.asarray(0.1)).shape == (5, planes.size)


@pytest.mark.usefixtures("x64")
class TestSinusoids:
    def test_values(self):
        found = sinusoids(jnp.array([[0.75]]), 2)
        x = 0.5
        expected = [x, np.sin(np.pi * x), np.sin(2 * np.pi * x), np.cos(np.pi * x), np.cos(2 * np.pi * x)]
        np.testing.assert_allclose(found[0], expected, atol=1e-12)

    def test_place_and_time(self):
        encoding = Sinusoids(3)
        found = encoding(jnp.full((2, 3), 0.5), jnp.asarray(0.25))
        assert found.shape == (2, encoding.size)
        np.testing.assert_allclose(found[:, :4], [[0, 0, 0, -0.5]] * 2)


class TestVoxels:
    @pytest.mark.thorough
    def test_position_and_time_are_encoded_separately(self):
        voxels = init_voxels(jax.random.key(0), 4, 3, 2, outputs=5)
        places = jnp.asarray(np.random.default_rng(5).uniform(size=(6, 3)), jnp.float32)
        early, late = voxels(places, jnp.asarray(0.2)), voxels(places, jnp.asarray(0.9))
        assert early.shape == (6, voxels.size)
        np.testing.assert_array_equal(early[:, :3], late[:, :3])
        assert (early[:, 3:] == early[:1, 3:]).all()
        assert not np.allclose(early[:, 3:], late[:, 3:])
        assert voxels.meaning(places).shape == (6, 5)
