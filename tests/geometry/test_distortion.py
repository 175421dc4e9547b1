"""Lens distortion of points: it agrees with OpenCV, derivatives are exact, and no NaN spreads."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.distortion import distort, distort_map, undistort
from tests.geometry.lenses import (
    check_derivatives,
    cv_distorted,
    cv_undistorted,
    every_lens,
    jitted_distort,
    jitted_undistort,
    lens_of,
    some_points,
    tangents_of,
    two_lenses,
    x64,
)


@x64
@every_lens
def test_points_are_distorted_and_undistorted_as_opencv_does(lens):
    model, coeffs = lens_of(lens)
    points = some_points(model)
    bent = jitted_distort(points, coeffs, model)
    np.testing.assert_allclose(bent, cv_distorted(points, coeffs, model), atol=1e-14)
    back = jitted_undistort(bent, coeffs, model)
    assert np.asarray(back.valid).all()
    np.testing.assert_allclose(back.points, points, atol=1e-12)
    np.testing.assert_allclose(back.points, cv_undistorted(bent, coeffs, model), atol=1e-8)


@every_lens
def test_float32_agrees_with_opencv_to_1e_6(lens):
    model, coeffs = lens_of(lens, np.float32)
    points = some_points(model, dtype=np.float32)
    bent = jitted_distort(points, coeffs, model)
    assert bent.dtype == np.float32
    np.testing.assert_allclose(bent, cv_distorted(points, coeffs, model), atol=1e-6)
    back = jitted_undistort(bent, coeffs, model)
    assert np.asarray(back.valid).all()
    # Rounding of the distorted point is amplified by up to 1 / cos^2, which is 13 at 74 degrees.
    np.testing.assert_allclose(back.points, points, atol=1e-5 if model == "opencv_fisheye" else 1e-6)


@pytest.mark.parametrize("num", [4, 5, 8])
def test_zero_coefficients_are_the_identity_to_the_bit(num):
    none = np.zeros(num, np.float32)
    points = np.concatenate([some_points(dtype=np.float32), np.float32([[0.0, 0], [1e-30, -1], [50, 30]])])
    np.testing.assert_array_equal(jitted_distort(points, none), points)
    back = jitted_undistort(points, none)
    np.testing.assert_array_equal(back.points, points)
    assert np.asarray(back.valid).all()


@pytest.mark.thorough
@x64
@pytest.mark.parametrize("lens", ["8", "fisheye"])
def test_derivatives_of_points(lens):
    model, coeffs = lens_of(lens)
    points = np.concatenate([some_points(model, 20), [[0.0, 0.0], [1e-4, 0.0]]])
    check_derivatives(lambda p, c: distort(p, c, model), (points, coeffs))
    bent = jitted_distort(points, coeffs, model)
    check_derivatives(lambda p, c: undistort(p, c, model).points, (bent, coeffs))


@pytest.mark.thorough
@x64
@two_lenses
def test_the_derivative_of_the_inverse_is_the_inverse_derivative(lens):
    model, coeffs = lens_of(lens)
    points, v = some_points(model, 20), tangents_of(some_points(model, 20))

    def there_and_back(p, c):
        return undistort(distort(p, c, model), c, model).points

    @jax.jit
    def pushed(p, c):
        return jax.jvp(there_and_back, (p, c), (v, jnp.ones_like(c)))

    same, push = pushed(points, coeffs)
    np.testing.assert_allclose(same, points, atol=1e-12)
    np.testing.assert_allclose(push, v, atol=1e-9)
    hessian = jax.jit(jax.hessian(lambda c: (undistort(points[0], c, model).points ** 2).sum()))(coeffs)
    hessian = np.asarray(hessian)
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    assert np.isfinite(hessian).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_beyond_the_fold_is_finite_not_valid_and_without_gradient(dtype):
    with jax.enable_x64(dtype is np.float64):
        coeffs = np.array([-0.3, 0.0, 0.0, 0.0], dtype)
        fold = np.sqrt(1 / 0.9)  # where r (1 - 0.3 r^2) has its maximum, 2/3 r
        top = 2 / 3 * fold
        radii = np.array([0.5 * top, 0.999 * top, 1.001 * top, 2.0, 1e3, 1e30], dtype)
        direction = np.array([0.6, -0.8], dtype)
        points, valid = jax.device_get(jitted_undistort(radii[:, None] * direction, coeffs))
        assert np.isfinite(points).all()
        np.testing.assert_array_equal(valid, [True, True, False, False, False, False])
        assert (np.linalg.norm(points[:3], axis=-1) <= fold * (1 + 1e-6)).all()

        @jax.jit
        @partial(jax.grad, argnums=(0, 1))
        def gradients(radii, coeffs):
            return undistort(radii[:, None] * direction, coeffs).points.sum()

        by_radii, by_coeffs = jax.device_get(gradients(radii, coeffs))
        assert np.isfinite(by_radii).all()
        assert np.isfinite(by_coeffs).all()
        np.testing.assert_array_equal(by_radii[~valid], 0.0)
        np.testing.assert_allclose(
            by_coeffs, gradients(np.where(valid, radii, dtype(0)), coeffs)[1], rtol=1e-6
        )


def test_a_point_that_comes_back_from_beyond_the_fold_is_not_mistaken():
    # Its polynomial falls beyond r = 1.05 and rises again beyond 1.7: three points share one image.
    coeffs = np.float32([-0.45, 0.0, 0.0, 0.0, 0.045])
    radii = np.linspace(0.05, 0.85, 17, dtype=np.float32)
    bent = jitted_distort(radii[:, None] * np.float32([1.0, 0.0]), coeffs)
    points, valid = jax.device_get(jitted_undistort(bent, coeffs))
    assert valid.all()
    np.testing.assert_allclose(points[:, 0], radii, atol=1e-5)
    far, valid = jax.device_get(jitted_undistort(np.float32([[3.0, 0.0], [0.0, -10.0]]), coeffs))
    assert not valid.any()
    assert np.isfinite(far).all()


@x64
def test_the_fisheye_ends_at_its_horizon():
    flat = np.zeros(4)
    angles = np.array([0.0, 1e-9, 1e-3, 0.5, 1.4, 1.56, np.pi / 2, 2.0, 3.0])
    bent = np.stack([angles, np.zeros(9)], -1)
    points, valid = jax.device_get(jitted_undistort(bent, flat, "opencv_fisheye"))
    np.testing.assert_array_equal(valid, angles < 1.57)
    np.testing.assert_allclose(points[:6, 0], np.tan(angles[:6]), rtol=1e-12, atol=1e-300)
    assert np.isfinite(points).all()
    again = np.asarray(jitted_distort(points[:6], flat, "opencv_fisheye"))
    np.testing.assert_allclose(again[:, 0], angles[:6], rtol=1e-12)


@pytest.mark.parametrize("lens", ["8", "fisheye"])
def test_what_is_not_finite_spoils_no_neighbour_and_no_gradient(lens):
    model, coeffs = lens_of(lens, np.float32)
    clean, others = np.asarray(some_points(num=5, dtype=np.float32)) / 2, np.array([0, 1, 3, 4])

    def forth(points, coeffs):
        return distort(points, coeffs, model)[others]

    def back(points, coeffs):
        return undistort(points, coeffs, model).points[others]

    for f in (forth, back):
        value, gradient = jax.jit(f), jax.jit(jax.grad(lambda p, c, f=f: f(p, c).sum(), (0, 1)))
        want_value, want = value(clean, coeffs), gradient(clean, coeffs)
        for poison in (np.nan, np.inf, -np.inf, 1e38):
            spoilt = clean.copy()
            spoilt[2, 1] = poison
            np.testing.assert_array_equal(value(spoilt, coeffs), want_value)
            by_points, by_coeffs = jax.device_get(gradient(spoilt, coeffs))
            np.testing.assert_array_equal(by_points, want[0])
            np.testing.assert_array_equal(by_points[2], 0.0)
            np.testing.assert_allclose(by_coeffs, want[1], rtol=1e-6)
            assert np.isnan(np.asarray(jitted_distort(spoilt, coeffs, model))[2]).all()
            points, valid = jitted_undistort(spoilt, coeffs, model)
            np.testing.assert_array_equal(valid, [True, True, False, True, True])
            assert np.isfinite(points).all()
        for poison in (np.nan, np.inf):
            broken = np.array(coeffs)
            broken[1] = poison
            assert np.isnan(jitted_distort(clean, broken, model)).all()
            points, valid = jitted_undistort(clean, broken, model)
            assert np.isfinite(points).all()
            assert not np.asarray(valid).any()
            for by in gradient(clean, broken):
                np.testing.assert_array_equal(by, 0.0)


def test_jit_and_vmap_are_the_loop():
    points = np.asarray(some_points(dtype=np.float32))
    lenses = np.float32([[0.1, 0.0, 0.0, 0.0], [-0.2, 0.05, 0.001, 0.0]])
    mapped = jax.device_get(jax.jit(jax.vmap(undistort, in_axes=(None, 0)))(points, lenses))
    for i in range(2):
        alone = jitted_undistort(points.reshape(4, 50, 2), lenses[i])
        np.testing.assert_allclose(mapped.points[i].reshape(4, 50, 2), alone.points, atol=1e-6)
        np.testing.assert_array_equal(mapped.valid[i].reshape(4, 50), alone.valid)


def test_what_is_not_a_lens_is_named():
    points = jnp.zeros((3, 2))
    with pytest.raises(ValueError, match="model: expected one of opencv, opencv_fisheye, found 'thin_prism'"):
        distort(points, jnp.zeros(4), "thin_prism")
    with pytest.raises(ValueError, match=r"coeffs: expected 4 or 5 or 8 .* opencv, found shape \(6,\)"):
        undistort(points, jnp.zeros(6))
    with pytest.raises(ValueError, match=r"expected 4 coefficients for opencv_fisheye, found shape \(5,\)"):
        distort_map(jnp.eye(3), jnp.zeros(5), 4, 4, model="opencv_fisheye")
