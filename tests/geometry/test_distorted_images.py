"""Distortion of images: maps and images agree with OpenCV, and a lens is calibrated through the
rasterizer."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from gsjax.geometry.cameras import intrinsics, look_at, pixel_grid, project
from gsjax.geometry.distortion import (
    distort_image,
    distort_map,
    sample,
    undistort_image,
    undistort_map,
    with_margin,
)
from gsjax.optim.least_squares import solve
from gsjax.rasterize.rasterization import plan, rasterization
from tests.geometry.lenses import (
    HEIGHT,
    PINHOLE_K,
    WIDTH,
    K,
    check_derivatives,
    cv_distorted,
    cv_undistorted,
    for_cv,
    lens_of,
    picture,
    two_lenses,
    x64,
)

undistorted_map = jax.jit(undistort_map, static_argnames=("width", "height", "model"))
distorted_map = jax.jit(distort_map, static_argnames=("width", "height", "model"))
undistorted_image = jax.jit(undistort_image, static_argnames=("size", "model"))
distorted_image = jax.jit(distort_image, static_argnames=("size", "model"))
sampled = jax.jit(sample)


@x64
@two_lenses
@pytest.mark.parametrize("pinhole", [None, PINHOLE_K], ids=["same", "other"])
def test_maps_are_those_of_opencv_half_a_pixel_on(lens, pinhole):
    model, coeffs = lens_of(lens)
    new = K if pinhole is None else pinhole
    init = cv2.fisheye.initUndistortRectifyMap if model == "opencv_fisheye" else cv2.initUndistortRectifyMap
    maps = init(for_cv(K), np.asarray(coeffs), np.eye(3), for_cv(new), (WIDTH, HEIGHT), cv2.CV_32FC1)
    pixels = np.asarray(undistorted_map(K, coeffs, WIDTH, HEIGHT, pinhole, model))
    np.testing.assert_allclose(pixels - 0.5, np.stack(maps, -1), atol=1e-5)  # theirs are float32


@x64
@two_lenses
def test_the_two_maps_are_inverse_also_with_skew(lens):
    model, coeffs = lens_of(lens)
    skewed = K.copy()
    skewed[0, 1] = 0.7
    there, valid = jax.device_get(distorted_map(skewed, coeffs, WIDTH, HEIGHT, PINHOLE_K, model))
    assert valid.all()
    inverse = np.linalg.inv(PINHOLE_K)
    rays = np.concatenate([there, np.ones((HEIGHT, WIDTH, 1))], -1) @ inverse.T
    bent = cv_distorted(rays[..., :2].reshape(-1, 2), coeffs, model)
    pixels = np.concatenate([bent, np.ones((len(bent), 1))], -1) @ skewed.T
    np.testing.assert_allclose(pixels[:, :2].reshape(HEIGHT, WIDTH, 2), pixel_grid(WIDTH, HEIGHT), atol=1e-9)


@x64
def test_sampling_is_bilinear_as_in_scipy_and_opencv():
    image = picture()
    pixels = np.random.default_rng(3).uniform([0.5, 0.5], [WIDTH - 0.5, HEIGHT - 0.5], (20, 30, 2))
    pixels[0, :3] = [[0.5, 0.5], [WIDTH - 0.5, HEIGHT - 0.5], [10.5, 7.5]]
    values, valid = jax.device_get(sampled(image, pixels))
    assert valid.all()
    at = np.moveaxis(pixels - 0.5, -1, 0)[::-1]
    want = np.stack([scipy.ndimage.map_coordinates(image[..., c], at, order=1) for c in range(3)], -1)
    np.testing.assert_allclose(values, want, atol=1e-12)
    np.testing.assert_allclose(values[0, 2], image[7, 10], atol=1e-15)
    # OpenCV rounds positions to 1/32 pixel, so these are rounded beforehand.
    coarse = np.round(pixels * 32) / 32
    x, y = np.float32(np.moveaxis(coarse - 0.5, -1, 0))
    theirs = cv2.remap(np.float32(image), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(sampled(image, coarse).image, theirs, atol=1e-5)


def test_sampling_says_what_lies_outside_or_has_no_value():
    image = np.float32(picture(6, 4))
    image[1, 2, 0] = np.nan
    pixels = np.float32([[[0.4, 2.0], [0.5, 2.0], [5.5, 3.5], [5.6, 3.5], [np.nan, 1.0]]])
    values, valid = jax.device_get(sampled(image, pixels))
    np.testing.assert_array_equal(valid, [[False, True, True, False, False]])
    np.testing.assert_array_equal(values[~valid], 0.0)
    centres = np.asarray(pixel_grid(6, 4))
    touched = sampled(image, centres + np.float32([0.25, 0.0])).valid
    expected = np.ones((4, 6), bool)
    expected[:, 5] = expected[1, 1] = expected[1, 2] = False
    np.testing.assert_array_equal(touched, expected)
    centred = sampled(image, centres)
    assert np.asarray(centred.valid).sum() == 23  # an invalid neighbour of weight 0 does no harm
    gradient = jax.jit(jax.grad(lambda i: sampled(i, centres + 0.25).image.sum()))(image)
    assert np.isfinite(gradient).all()


@two_lenses
def test_photographs_are_undistorted_as_opencv_does(lens):
    model, coeffs = lens_of(lens, np.float32)
    photo = np.float32(picture(blur=3.0))
    ours = jax.device_get(undistorted_image(photo, np.float32(K), coeffs, model=model))
    if model == "opencv_fisheye":
        theirs = cv2.fisheye.undistortImage(photo, for_cv(K), np.float64(coeffs), Knew=for_cv(K))
    else:
        theirs = cv2.undistort(photo, for_cv(K), np.float64(coeffs))
    assert ours.valid.mean() > 0.5
    slope = np.abs(np.diff(photo, axis=0)).max() + np.abs(np.diff(photo, axis=1)).max()
    np.testing.assert_allclose(ours.image[ours.valid], theirs[ours.valid], atol=slope / 32)


def test_the_optical_axis_stays_where_it_is():
    # The axis meets the centre of pixel (10, 20); with any other convention a strong lens would move it.
    centred, image = np.float32(K), np.float32(picture())
    centred[:2, 2] = [20.5, 10.5]
    for warp in (distorted_image, undistorted_image):
        warped, valid = jax.device_get(warp(image, centred, np.float32([-0.3, 0.1, 0.0, 0.0])))
        assert valid[10, 20]
        np.testing.assert_allclose(warped[10, 20], image[10, 20], atol=1e-5)
        assert np.abs(warped[10, 30] - image[10, 30]).max() > 0.01


def test_no_lens_changes_no_image():
    image = np.float32(picture())
    for warp in (distorted_image, undistorted_image):
        warped, valid = warp(image, np.float32(K), np.zeros(5, np.float32))
        assert np.asarray(valid).all()
        np.testing.assert_allclose(warped, image, atol=1e-5)


@x64
@two_lenses
def test_a_distorted_image_shows_what_opencv_projects(lens):
    model, coeffs = lens_of(lens)
    wide_K, width, height = with_margin(jnp.asarray(K), WIDTH, HEIGHT, 40)
    wide_K = np.asarray(wide_K)

    def scene(points):  # colours by direction, smooth enough for bilinear interpolation to be accurate
        return np.stack([np.sin(3 * points[..., 0]), np.cos(2 * points[..., 1]), points[..., 0]], -1)

    rays = (np.asarray(pixel_grid(width, height)) - wide_K[:2, 2]) / np.diag(wide_K)[:2]
    warped, valid = distorted_image(
        scene(rays), K, coeffs, pinhole_K=wide_K, size=(WIDTH, HEIGHT), model=model
    )
    assert np.asarray(valid).all()
    pixels = (np.asarray(pixel_grid(WIDTH, HEIGHT)) - K[:2, 2]) / np.diag(K)[:2]
    seen = cv_undistorted(pixels.reshape(-1, 2), coeffs, model).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(warped, scene(seen), atol=2e-3)


@pytest.mark.thorough
@x64
def test_derivatives_of_a_distorted_image():
    model, coeffs = lens_of("5")
    wide_K, width, height = with_margin(jnp.asarray(K), WIDTH, HEIGHT, 40)
    image = jnp.asarray(picture(width, height))

    def warped(image, K, wide_K, coeffs):
        return distort_image(image, K, coeffs, pinhole_K=wide_K, size=(WIDTH, HEIGHT), model=model).image

    check_derivatives(warped, (image, jnp.asarray(K), wide_K, coeffs), step=1e-7, rtol=1e-5)


# ------------------------------------------------------------------ through the rasterizer

VIEWMAT = jnp.asarray(look_at(np.array([1.6, 0.3, 0.9]), np.zeros(3)), jnp.float32)
MARGIN = 12


def rendered(scene, camera, plan):
    """A pinhole image [height, width, 3] with MARGIN around it."""
    wide, width, height = with_margin(camera, WIDTH, HEIGHT, MARGIN)
    image, _, meta = rasterization(
        **scene, viewmats=VIEWMAT[None], Ks=wide[None], width=width, height=height, plan=plan
    )
    return image[0], wide, meta


def scene_and_plan(means, sigma, seed=0, **options):
    rng = np.random.default_rng(seed)
    n = len(means)
    arrays = {
        "means": means,
        "quats": rng.normal(size=(n, 4)),
        "scales": np.full((n, 3), sigma),
        "opacities": np.full(n, 0.8),
    }
    scene = {k: jnp.asarray(np.float32(v)) for k, v in arrays.items()}
    wide, width, height = with_margin(jnp.asarray(intrinsics(36.0, WIDTH, HEIGHT)), WIDTH, HEIGHT, MARGIN)
    p = plan(*scene.values(), VIEWMAT[None], wide[None], width, height, headroom=2.0, **options)
    return scene | {"colors": jnp.asarray(np.float32(rng.uniform(size=(n, 3))))}, p


@pytest.mark.thorough
@pytest.mark.parametrize("lens", ["4", "fisheye"])
def test_a_gaussian_is_seen_where_opencv_projects_its_centre(lens):
    model, coeffs = lens_of(lens, np.float32)
    camera = jnp.asarray(intrinsics(36.0, WIDTH, HEIGHT), jnp.float32)
    centre = np.array([[0.2, 0.7, -0.4]])
    scene, p = scene_and_plan(centre, 0.04)

    @jax.jit
    def through_the_lens(scene):
        image, wide, _ = rendered(scene, camera, p)
        return distort_image(image, camera, coeffs, pinhole_K=wide, size=(WIDTH, HEIGHT), model=model)

    seen, valid = jax.device_get(through_the_lens(scene))
    weights = np.where(valid, seen.sum(-1), 0.0)
    found = (weights[..., None] * pixel_grid(WIDTH, HEIGHT)).sum((0, 1)) / weights.sum()
    K_cv, R, t = for_cv(camera), np.asarray(VIEWMAT[:3, :3], np.float64), np.float64(VIEWMAT[:3, 3])
    if model == "opencv_fisheye":
        want = cv2.fisheye.projectPoints(centre[None], cv2.Rodrigues(R)[0], t, K_cv, np.float64(coeffs))[0]
    else:
        want = cv2.projectPoints(centre, cv2.Rodrigues(R)[0], t, K_cv, np.float64(coeffs))[0]
    plain, _ = jax.jit(project)(np.float32(centre), VIEWMAT, camera)
    assert np.linalg.norm(want.ravel() + 0.5 - np.asarray(plain)) > 0.5  # the lens has a visible effect
    np.testing.assert_allclose(
        found, want.ravel() + 0.5, atol=0.1
    )  # a blob's centroid is not the image of its centre


def of_lens(params, batch, *, step, key):
    focal, coeffs = params["focal"] * 36.0, jnp.pad(params["k"], (0, 2))
    camera = batch["K"].at[0, 0].set(focal).at[1, 1].set(focal)
    image, wide, meta = rendered(batch["scene"], camera, batch["plan"])
    seen = distort_image(image, camera, coeffs, pinhole_K=wide, size=(WIDTH, HEIGHT))
    return seen.image - batch["photo"], {"overflow": meta.overflow, "valid": seen.valid.all()}


@pytest.mark.slow
def test_a_lens_is_calibrated_from_one_photograph():
    means = np.random.default_rng(1).uniform(-1.0, 1.0, (150, 3)) * [0.5, 1.0, 0.8]
    scene, p = scene_and_plan(means, 0.06, derivative="forward")
    camera = jnp.asarray(intrinsics(36.0, WIDTH, HEIGHT), jnp.float32)
    batch = {"scene": scene, "plan": p, "K": camera, "photo": jnp.zeros((HEIGHT, WIDTH, 3))}
    truth = {"focal": jnp.array(37.5 / 36.0), "k": jnp.array([-0.22, 0.06])}
    photo, _ = jax.jit(partial(of_lens, step=0, key=None))(truth, batch)
    start = {"focal": jnp.ones(()), "k": jnp.zeros(2)}
    found, info = solve(of_lens, start, batch | {"photo": photo}, damping=0.1, max_steps=30)
    assert info["valid"]
    assert not info["overflow"].any()
    np.testing.assert_allclose(found["k"], truth["k"], atol=1e-3)
    np.testing.assert_allclose(found["focal"], truth["focal"], atol=1e-4)
    assert info["converged"]
