"""Shared by the tests of lens distortion: lenses, OpenCV's results for them, and a check of derivatives."""

import cv2
import jax
import numpy as np
import pytest
import scipy.ndimage

from gsjax.geometry.distortion import distort, undistort

LENSES = {
    "4": ("opencv", [-0.28, 0.07, 1e-3, -5e-4]),
    "5": ("opencv", [-0.3, 0.12, -8e-4, 2e-3, -0.02]),
    "8": ("opencv", [0.6, -0.4, 1e-3, 6e-4, 0.05, 0.9, -0.3, 0.1]),
    "pincushion": ("opencv", [0.25, 0.1, 0.0, 1e-3]),
    "fisheye": ("opencv_fisheye", [-0.03, 0.01, -4e-3, 5e-4]),
}
WIDTH, HEIGHT = 48, 32
K = np.array([[40.0, 0.0, 23.1], [0.0, 42.0, 17.3], [0.0, 0.0, 1.0]])
PINHOLE_K = np.array([[36.0, 0.0, 25.0], [0.0, 35.0, 15.5], [0.0, 0.0, 1.0]])
jitted_distort = jax.jit(distort, static_argnames="model")
jitted_undistort = jax.jit(undistort, static_argnames="model")
every_lens = pytest.mark.parametrize("lens", LENSES)
two_lenses = pytest.mark.parametrize("lens", ["5", "fisheye"])
x64 = pytest.mark.usefixtures("x64")


def lens_of(name, dtype=np.float64):
    model, coeffs = LENSES[name]
    return model, jax.device_put(np.asarray(coeffs, dtype))


def some_points(model="opencv", num=200, dtype=np.float64):
    reach = 2.5 if model == "opencv_fisheye" else 0.6
    return jax.device_put(np.random.default_rng(0).uniform(-reach, reach, (num, 2)).astype(dtype))


def cv_distorted(points, coeffs, model):
    points, coeffs = np.asarray(points, np.float64), np.asarray(coeffs, np.float64)
    if model == "opencv_fisheye":
        return cv2.fisheye.distortPoints(points[:, None], np.eye(3), coeffs)[:, 0]
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=-1)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), coeffs)[0][:, 0]


def cv_undistorted(points, coeffs, model):
    points, coeffs = np.asarray(points, np.float64)[:, None], np.asarray(coeffs, np.float64)
    until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    if model == "opencv_fisheye":
        return cv2.fisheye.undistortPoints(points, np.eye(3), coeffs, criteria=until)[:, 0]
    return cv2.undistortPoints(points, np.eye(3), coeffs, R=np.eye(3), P=np.eye(3), criteria=until)[:, 0]


def for_cv(matrix):
    """The same K in OpenCV's convention, with pixel centres at integers."""
    matrix = np.array(matrix, np.float64)
    matrix[:2, 2] -= 0.5
    return matrix


def picture(width=WIDTH, height=HEIGHT, seed=0, blur=1.5):
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    return scipy.ndimage.gaussian_filter(noise, (blur, blur, 0)) * 3


def tangents_of(tree, seed=1):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: rng.normal(size=a.shape).astype(a.dtype), tree)


def check_derivatives(f, args, step=1e-6, rtol=1e-6):
    """Checks jvp against central differences, argument by argument, and vjp against jvp."""
    value = jax.jit(f)
    push = jax.jit(lambda args, v: jax.jvp(f, args, v)[1])
    pull = jax.jit(lambda args, w: jax.vjp(f, *args)[1](w))
    weights = tangents_of(value(*args), seed=2)
    pulled = pull(args, weights)
    for i, direction in enumerate(tangents_of(args)):
        v = tuple(direction if j == i else np.zeros_like(a) for j, a in enumerate(args))
        ahead, behind = (
            np.asarray(value(*(a + s * step * t for a, t in zip(args, v, strict=True)))) for s in (1, -1)
        )
        difference = (ahead - behind) / (2 * step)
        scale = float(np.abs(difference).max())
        assert scale > 1e-3
        pushed = push(args, v)
        np.testing.assert_allclose(pushed, difference, atol=rtol * scale)
        np.testing.assert_allclose(np.vdot(pulled[i], direction), np.vdot(weights, pushed), rtol=1e-9)
