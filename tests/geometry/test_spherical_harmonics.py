"""Real spherical harmonics against scipy's complex ones, and their properties."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import sph_harm_y

from gsjax.geometry.spherical_harmonics import evaluate_sh, num_sh_bases, rgb_to_sh0, sh_bases

pytestmark = pytest.mark.usefixtures("x64")


def directions(count, seed=0):
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def real_harmonics(degree, d):
    """Y_lm of 3DGS: sqrt(2) times the imaginary (m < 0) or real (m > 0) part of Y_l|m|, with its
    Condon-Shortley phase."""
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            y = sph_harm_y(l, abs(m), theta, phi)
            columns.append(y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real))
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bases_equal_scipys(degree):
    d = directions(100)
    bases = sh_bases(degree, jnp.asarray(d))
    assert bases.shape == (100, num_sh_bases(degree))
    np.testing.assert_allclose(bases, real_harmonics(degree, d), atol=1e-12)


def test_bases_are_orthonormal_on_the_sphere():
    nodes, weights = np.polynomial.legendre.leggauss(8)  # exact for these polynomials
    phi = np.arange(16) * 2 * np.pi / 16
    z, angle = np.meshgrid(nodes, phi, indexing="ij")
    r = np.sqrt(1 - z**2)
    d = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)
    area = np.repeat(weights, 16) * 2 * np.pi / 16
    bases = np.asarray(sh_bases(3, jnp.asarray(d)))
    np.testing.assert_allclose(bases.T @ (area[:, None] * bases), np.eye(16), atol=1e-12)


def test_colours_do_not_depend_on_the_length_of_a_direction_nor_on_unread_coefficients():
    rng = np.random.default_rng(1)
    coefficients = jnp.asarray(rng.normal(size=(10, 16, 3)))
    d = jnp.asarray(directions(10))
    color = evaluate_sh(2, coefficients, d)
    np.testing.assert_allclose(evaluate_sh(2, coefficients.at[:, 9:].set(7.0), 5.0 * d), color, atol=1e-12)
    np.testing.assert_allclose(color, jnp.einsum("nk,nkc->nc", sh_bases(2, d), coefficients[:, :9]) + 0.5)


def test_no_direction_is_finite_with_zero_gradient():
    coefficients = jnp.ones((1, 16, 3))
    value, gradient = jax.jit(jax.value_and_grad(lambda d: evaluate_sh(3, coefficients, d).sum()))(
        jnp.zeros((1, 3))
    )
    assert np.isfinite(value)
    np.testing.assert_array_equal(gradient, 0)


def test_degree_0_stores_a_colour():
    rgb = jnp.array([[0.1, 0.5, 0.9]])
    np.testing.assert_allclose(evaluate_sh(0, rgb_to_sh0(rgb)[:, None], jnp.ones((1, 3))), rgb, atol=1e-12)


@pytest.mark.parametrize("degree", [-1, 4])
def test_other_degrees_are_refused(degree):
    with pytest.raises(ValueError, match=f"degree: expected 0, 1, 2 or 3, found {degree}"):
        sh_bases(degree, jnp.ones((1, 3)))
