"""Quaternions and rotation vectors against scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from gsjax.geometry.rotations import matrix_of, multiply_quats, normalize_quats, quats_to_matrices

pytestmark = pytest.mark.usefixtures("x64")


def random_quats(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=(*shape, 4)) * 3.0


def scipy_rotation(quats):
    return Rotation.from_quat(np.asarray(quats)[..., [1, 2, 3, 0]])  # scipy stores xyzw


def test_matrices_of_quaternions_of_any_length():
    quats = random_quats(50)
    matrices = quats_to_matrices(jnp.asarray(quats))
    np.testing.assert_allclose(matrices, scipy_rotation(quats).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(quats_to_matrices(jnp.asarray(-7.0 * quats)), matrices, atol=1e-12)
    assert quats_to_matrices(jnp.asarray(random_quats(2, 3))).shape == (2, 3, 3, 3)


def test_a_product_is_one_rotation_after_the_other():
    a, b = random_quats(20), random_quats(20, seed=1)
    product = multiply_quats(jnp.asarray(a), jnp.asarray(b))
    want = (scipy_rotation(a) * scipy_rotation(b)).as_matrix()
    np.testing.assert_allclose(quats_to_matrices(product), want, atol=1e-12)


@pytest.mark.parametrize("quat", [np.zeros(4), np.full(4, 1e-7), np.full(4, 5e-324)])
def test_what_names_no_rotation_is_the_identity_without_gradient(quat):
    np.testing.assert_array_equal(normalize_quats(jnp.asarray(quat)), [1, 0, 0, 0])
    jacobian = jax.jacrev(quats_to_matrices)(jnp.asarray(quat))
    np.testing.assert_array_equal(jacobian, 0)


def test_length_has_no_gradient():
    quat = jnp.asarray(random_quats())
    along = jax.jvp(quats_to_matrices, (quat,), (quat,))[1]
    np.testing.assert_allclose(along, 0, atol=1e-13)


@given(arrays(np.float64, 3, elements=st.floats(-6, 6)))
def test_a_rotation_vector_becomes_its_matrix(vector):
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(matrix_of(jnp.asarray(vector)), expected, atol=1e-12)


@pytest.mark.parametrize("length", [0.0, 1e-8, 1e-4, 1.0])
def test_the_matrix_of_a_rotation_vector_has_a_derivative_also_at_rest(length):
    vector, step = length * np.array([0.6, 0.0, -0.8]), 1e-6
    found = jax.jacobian(matrix_of)(jnp.asarray(vector))
    for i, along in enumerate(step * np.eye(3)):
        ahead, behind = (Rotation.from_rotvec(vector + s * along).as_matrix() for s in (1, -1))
        np.testing.assert_allclose(found[..., i], (ahead - behind) / (2 * step), atol=1e-8)
