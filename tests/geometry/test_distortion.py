"""Lens distortion: OpenCV agrees with points and images, derivatives are exact, and nothing turns NaN."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

from gsjax.geometry.cameras import intrinsics, look_at, pixel_grid, project
from gsjax.geometry.distortion import (
    distort,
    distort_image,
    distort_map,
    sample,
    undistort,
    undistort_image,
    undistort_map,
    with_margin,
)
from gsjax.optim.least_squares import solve
from gsjax.rasterize.rasterization import plan, rasterization

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
    return model, jnp.asarray(coeffs, dtype)


def some_points(model="opencv", num=200, dtype=np.float64):
    reach = 2.5 if model == "opencv_fisheye" else 0.6
    return jnp.asarray(np.random.default_rng(0).uniform(-reach, reach, (num, 2)), dtype)


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
    """The same K where pixel centres are counted at integers."""
    matrix = np.array(matrix, np.float64)
    matrix[:2, 2] -= 0.5
    return matrix


def picture(width=WIDTH, height=HEIGHT, seed=0, blur=1.5):
    noise = np.random.default_rng(seed).normal(size=(height, width, 3))
    return scipy.ndimage.gaussian_filter(noise, (blur, blur, 0)) * 3


def tangents_of(tree, seed=1):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape), a.dtype), tree)


def check_derivatives(f, args, step=1e-6, rtol=1e-6):
    """jvp against central differences, argument by argument, and vjp against jvp."""
    value = jax.jit(f)
    push = jax.jit(lambda args, v: jax.jvp(f, args, v)[1])
    pull = jax.jit(lambda args, w: jax.vjp(f, *args)[1](w))
    weights = tangents_of(value(*args), seed=2)
    pulled = pull(args, weights)
    for i, direction in enumerate(tangents_of(args)):
        v = tuple(direction if j == i else jnp.zeros_like(a) for j, a in enumerate(args))
        ahead, behind = (value(*(a + s * step * t for a, t in zip(args, v, strict=True))) for s in (1, -1))
        difference = (ahead - behind) / (2 * step)
        scale = float(jnp.abs(difference).max())
        assert scale > 1e-3
        pushed = push(args, v)
        np.testing.assert_allclose(pushed, difference, atol=rtol * scale)
        np.testing.assert_allclose(jnp.vdot(pulled[i], direction), jnp.vdot(weights, pushed), rtol=1e-9)


# ------------------------------------------------------------------ points


@x64
@every_lens
def test_points_are_distorted_and_undistorted_as_opencv_does(lens):
    model, coeffs = lens_of(lens)
    points = some_points(model)
    bent = jitted_distort(points, coeffs, model)
    np.testing.assert_allclose(bent, cv_distorted(points, coeffs, model), atol=1e-14)
    back = jitted_undistort(bent, coeffs, model)
    assert back.valid.all()
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
    assert back.valid.all()
    # How far rounding of the distorted point moves the undistorted one: up to 1 / cos^2, 13 at 74 degrees.
    np.testing.assert_allclose(back.points, points, atol=1e-5 if model == "opencv_fisheye" else 1e-6)


@pytest.mark.parametrize("num", [4, 5, 8])
def test_zero_coefficients_are_the_identity_to_the_bit(num):
    points = jnp.concatenate([some_points(dtype=np.float32), jnp.array([[0.0, 0], [1e-30, -1], [50, 30]])])
    np.testing.assert_array_equal(distort(points, jnp.zeros(num)), points)
    back = undistort(points, jnp.zeros(num))
    np.testing.assert_array_equal(back.points, points)
    assert back.valid.all()


@x64
@pytest.mark.parametrize("lens", ["8", "fisheye"])
def test_derivatives_of_points(lens):
    model, coeffs = lens_of(lens)
    points = jnp.concatenate([some_points(model, 20), jnp.array([[0.0, 0.0], [1e-4, 0.0]])])
    check_derivatives(lambda p, c: distort(p, c, model), (points, coeffs))
    bent = distort(points, coeffs, model)
    check_derivatives(lambda p, c: undistort(p, c, model).points, (bent, coeffs))


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
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-9)
    assert np.isfinite(hessian).all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_beyond_the_fold_is_finite_not_valid_and_without_gradient(dtype):
    with jax.enable_x64(dtype is np.float64):
        coeffs = jnp.asarray([-0.3, 0.0, 0.0, 0.0], dtype)
        fold = np.sqrt(1 / 0.9)  # r (1 - 0.3 r^2) is largest there: 2/3 of it
        top = 2 / 3 * fold
        radii = jnp.asarray([0.5 * top, 0.999 * top, 1.001 * top, 2.0, 1e3, 1e30], dtype)
        direction = jnp.asarray([0.6, -0.8], dtype)
        points, valid = undistort(radii[:, None] * direction, coeffs)
        assert np.isfinite(points).all()
        np.testing.assert_array_equal(valid, [True, True, False, False, False, False])
        assert (jnp.linalg.norm(points[:3], axis=-1) <= fold * (1 + 1e-6)).all()

        @jax.jit
        @partial(jax.grad, argnums=(0, 1))
        def gradients(radii, coeffs):
            return undistort(radii[:, None] * direction, coeffs).points.sum()

        by_radii, by_coeffs = gradients(radii, coeffs)
        assert np.isfinite(by_radii).all()
        assert np.isfinite(by_coeffs).all()
        np.testing.assert_array_equal(by_radii[~valid], 0.0)
        np.testing.assert_allclose(by_coeffs, gradients(jnp.where(valid, radii, 0), coeffs)[1], rtol=1e-6)


def test_a_point_that_comes_back_from_beyond_the_fold_is_not_mistaken():
    # Its polynomial falls behind r = 1.05 and rises again behind 1.7: three points share one image.
    coeffs = jnp.array([-0.45, 0.0, 0.0, 0.0, 0.045])
    radii = jnp.linspace(0.05, 0.85, 17)
    bent = distort(radii[:, None] * jnp.array([1.0, 0.0]), coeffs)
    points, valid = undistort(bent, coeffs)
    assert valid.all()
    np.testing.assert_allclose(points[:, 0], radii, atol=1e-5)
    far, valid = undistort(jnp.array([[3.0, 0.0], [0.0, -10.0]]), coeffs)
    assert not valid.any()
    assert np.isfinite(far).all()


@x64
def test_the_fisheye_ends_at_its_horizon():
    flat = jnp.zeros(4)
    angles = jnp.array([0.0, 1e-9, 1e-3, 0.5, 1.4, 1.56, np.pi / 2, 2.0, 3.0])
    points, valid = undistort(jnp.stack([angles, jnp.zeros(9)], -1), flat, "opencv_fisheye")
    np.testing.assert_array_equal(valid, angles < 1.57)
    np.testing.assert_allclose(points[:6, 0], np.tan(angles[:6]), rtol=1e-12, atol=1e-300)
    assert np.isfinite(points).all()
    again = distort(points[:6], flat, "opencv_fisheye")
    np.testing.assert_allclose(again[:, 0], angles[:6], rtol=1e-12)


@pytest.mark.parametrize("lens", ["8", "fisheye"])
def test_what_is_not_finite_spoils_no_neighbour_and_no_gradient(lens):
    model, coeffs = lens_of(lens, np.float32)
    clean, others = some_points(num=5, dtype=np.float32) / 2, np.array([0, 1, 3, 4])

    def forth(points, coeffs):
        return distort(points, coeffs, model)[others]

    def back(points, coeffs):
        return undistort(points, coeffs, model).points[others]

    for f in (forth, back):
        value, gradient = jax.jit(f), jax.jit(jax.grad(lambda p, c, f=f: f(p, c).sum(), (0, 1)))
        want_value, want = value(clean, coeffs), gradient(clean, coeffs)
        for poison in (np.nan, np.inf, -np.inf, 1e38):
            spoilt = clean.at[2, 1].set(poison)
            np.testing.assert_array_equal(value(spoilt, coeffs), want_value)
            by_points, by_coeffs = gradient(spoilt, coeffs)
            np.testing.assert_array_equal(by_points, want[0])
            np.testing.assert_array_equal(by_points[2], 0.0)
            np.testing.assert_allclose(by_coeffs, want[1], rtol=1e-6)
            assert np.isnan(jitted_distort(spoilt, coeffs, model)[2]).all()
            points, valid = jitted_undistort(spoilt, coeffs, model)
            np.testing.assert_array_equal(valid, [True, True, False, True, True])
            assert np.isfinite(points).all()
        for poison in (np.nan, np.inf):
            broken = coeffs.at[1].set(poison)
            assert np.isnan(jitted_distort(clean, broken, model)).all()
            points, valid = jitted_undistort(clean, broken, model)
            assert np.isfinite(points).all()
            assert not valid.any()
            for by in gradient(clean, broken):
                np.testing.assert_array_equal(by, 0.0)


def test_jit_and_vmap_are_the_loop():
    points, lenses = (
        some_points(dtype=np.float32),
        jnp.array([[0.1, 0.0, 0.0, 0.0], [-0.2, 0.05, 0.001, 0.0]]),
    )
    mapped = jax.jit(jax.vmap(undistort, in_axes=(None, 0)))(points, lenses)
    for i in range(2):
        alone = undistort(points.reshape(4, 50, 2), lenses[i])
        np.testing.assert_allclose(mapped.points[i].reshape(4, 50, 2), alone.points, atol=1e-6)
        np.testing.assert_array_equal(mapped.valid[i].reshape(4, 50), alone.valid)


def test_what_is_not_a_lens_is_named():
    points = jnp.zeros((3, 2))
    with pytest.raises(ValueError, match="model is one of opencv, opencv_fisheye"):
        distort(points, jnp.zeros(4), "thin_prism")
    with pytest.raises(ValueError, match=r"\(4, 5, 8\) in number, but have shape \(6,\)"):
        undistort(points, jnp.zeros(6))
    with pytest.raises(ValueError, match=r"opencv_fisheye are \(4,\)"):
        distort_map(jnp.eye(3), jnp.zeros(5), 4, 4, model="opencv_fisheye")


# ------------------------------------------------------------------ images


@x64
@two_lenses
@pytest.mark.parametrize("pinhole", [None, PINHOLE_K], ids=["same", "other"])
def test_maps_are_those_of_opencv_half_a_pixel_on(lens, pinhole):
    model, coeffs = lens_of(lens)
    new = K if pinhole is None else pinhole
    init = cv2.fisheye.initUndistortRectifyMap if model == "opencv_fisheye" else cv2.initUndistortRectifyMap
    maps = init(for_cv(K), np.asarray(coeffs), np.eye(3), for_cv(new), (WIDTH, HEIGHT), cv2.CV_32FC1)
    pixels = undistort_map(
        jnp.asarray(K), coeffs, WIDTH, HEIGHT, None if pinhole is None else jnp.asarray(pinhole), model
    )
    np.testing.assert_allclose(pixels - 0.5, np.stack(maps, -1), atol=1e-5)  # theirs are float32


@x64
@two_lenses
def test_the_two_maps_are_inverse_also_with_skew(lens):
    model, coeffs = lens_of(lens)
    skewed = jnp.asarray(K).at[0, 1].set(0.7)
    there, valid = distort_map(skewed, coeffs, WIDTH, HEIGHT, jnp.asarray(PINHOLE_K), model)
    assert valid.all()
    inverse = np.linalg.inv(PINHOLE_K)
    rays = np.concatenate([there, np.ones((HEIGHT, WIDTH, 1))], -1) @ inverse.T
    bent = cv_distorted(rays[..., :2].reshape(-1, 2), coeffs, model)
    pixels = np.concatenate([bent, np.ones((len(bent), 1))], -1) @ np.asarray(skewed).T
    np.testing.assert_allclose(pixels[:, :2].reshape(HEIGHT, WIDTH, 2), pixel_grid(WIDTH, HEIGHT), atol=1e-9)


@x64
def test_sampling_is_bilinear_as_in_scipy_and_opencv():
    image = picture()
    pixels = np.random.default_rng(3).uniform([0.5, 0.5], [WIDTH - 0.5, HEIGHT - 0.5], (20, 30, 2))
    pixels[0, :3] = [[0.5, 0.5], [WIDTH - 0.5, HEIGHT - 0.5], [10.5, 7.5]]
    values, valid = sample(jnp.asarray(image), jnp.asarray(pixels))
    assert valid.all()
    at = np.moveaxis(pixels - 0.5, -1, 0)[::-1]
    want = np.stack([scipy.ndimage.map_coordinates(image[..., c], at, order=1) for c in range(3)], -1)
    np.testing.assert_allclose(values, want, atol=1e-12)
    np.testing.assert_allclose(values[0, 2], image[7, 10], atol=1e-15)
    # OpenCV rounds positions to 1/32 pixel, so it is given such.
    coarse = np.round(pixels * 32) / 32
    x, y = np.float32(np.moveaxis(coarse - 0.5, -1, 0))
    theirs = cv2.remap(np.float32(image), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(sample(jnp.asarray(image), jnp.asarray(coarse)).image, theirs, atol=1e-5)


def test_sampling_says_what_lies_outside_or_has_no_value():
    image = jnp.asarray(picture(6, 4), jnp.float32).at[1, 2, 0].set(jnp.nan)
    pixels = jnp.array([[[0.4, 2.0], [0.5, 2.0], [5.5, 3.5], [5.6, 3.5], [jnp.nan, 1.0]]])
    values, valid = sample(image, pixels)
    np.testing.assert_array_equal(valid, [[False, True, True, False, False]])
    np.testing.assert_array_equal(values[~valid], 0.0)
    touched = sample(image, pixel_grid(6, 4) + jnp.array([0.25, 0.0])).valid
    expected = np.ones((4, 6), bool)
    expected[:, 5] = expected[1, 1] = expected[1, 2] = False
    np.testing.assert_array_equal(touched, expected)
    centred = sample(image, pixel_grid(6, 4))
    assert centred.valid.sum() == 23  # of weight 0 no neighbour spoils anything
    gradient = jax.grad(lambda i: sample(i, pixel_grid(6, 4) + 0.25).image.sum())(image)
    assert np.isfinite(gradient).all()


@two_lenses
def test_photographs_are_undistorted_as_opencv_does(lens):
    model, coeffs = lens_of(lens, np.float32)
    photo = np.float32(picture(blur=3.0))
    ours = undistort_image(jnp.asarray(photo), jnp.asarray(K, jnp.float32), coeffs, model=model)
    if model == "opencv_fisheye":
        theirs = cv2.fisheye.undistortImage(photo, for_cv(K), np.float64(coeffs), Knew=for_cv(K))
    else:
        theirs = cv2.undistort(photo, for_cv(K), np.float64(coeffs))
    assert ours.valid.mean() > 0.5
    slope = np.abs(np.diff(photo, axis=0)).max() + np.abs(np.diff(photo, axis=1)).max()
    np.testing.assert_allclose(ours.image[ours.valid], theirs[ours.valid], atol=slope / 32)


def test_the_optical_axis_stays_where_it_is():
    # The axis meets the centre of pixel (10, 20): counted from anywhere else, a strong lens would move it.
    centred = jnp.asarray(K, jnp.float32).at[:2, 2].set(jnp.array([20.5, 10.5]))
    image = jnp.asarray(picture(), jnp.float32)
    for warp in (distort_image, undistort_image):
        warped, valid = warp(image, centred, jnp.array([-0.3, 0.1, 0.0, 0.0]))
        assert valid[10, 20]
        np.testing.assert_allclose(warped[10, 20], image[10, 20], atol=1e-5)
        assert jnp.abs(warped[10, 30] - image[10, 30]).max() > 0.01


def test_no_lens_changes_no_image():
    image, matrix = jnp.asarray(picture(), jnp.float32), jnp.asarray(K, jnp.float32)
    for warp in (distort_image, undistort_image):
        warped, valid = warp(image, matrix, jnp.zeros(5))
        assert valid.all()
        np.testing.assert_allclose(warped, image, atol=1e-5)


@x64
@two_lenses
def test_a_distorted_image_shows_what_opencv_projects(lens):
    model, coeffs = lens_of(lens)
    wide_K, width, height = with_margin(jnp.asarray(K), WIDTH, HEIGHT, 40)

    def scene(points):  # colours by direction, so smooth that bilinear interpolation hardly errs
        return jnp.stack([jnp.sin(3 * points[..., 0]), jnp.cos(2 * points[..., 1]), points[..., 0]], -1)

    rays = (pixel_grid(width, height) - wide_K[:2, 2]) / jnp.diag(wide_K)[:2]
    warped, valid = distort_image(
        scene(rays), jnp.asarray(K), coeffs, pinhole_K=wide_K, size=(WIDTH, HEIGHT), model=model
    )
    assert valid.all()
    pixels = (np.asarray(pixel_grid(WIDTH, HEIGHT)) - K[:2, 2]) / np.diag(K)[:2]
    seen = cv_undistorted(pixels.reshape(-1, 2), coeffs, model).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(warped, scene(seen), atol=2e-3)


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
    scene = {k: jnp.asarray(v, jnp.float32) for k, v in arrays.items()}
    wide, width, height = with_margin(jnp.asarray(intrinsics(36.0, WIDTH, HEIGHT)), WIDTH, HEIGHT, MARGIN)
    p = plan(*scene.values(), VIEWMAT[None], wide[None], width, height, headroom=2.0, **options)
    return scene | {"colors": jnp.asarray(rng.uniform(size=(n, 3)), jnp.float32)}, p


@pytest.mark.parametrize("lens", ["4", "fisheye"])
def test_a_gaussian_is_seen_where_opencv_projects_its_centre(lens):
    model, coeffs = lens_of(lens, np.float32)
    camera = jnp.asarray(intrinsics(36.0, WIDTH, HEIGHT), jnp.float32)
    centre = np.array([[0.2, 0.7, -0.4]])
    scene, p = scene_and_plan(centre, 0.04)
    image, wide, _ = rendered(scene, camera, p)
    seen, valid = distort_image(image, camera, coeffs, pinhole_K=wide, size=(WIDTH, HEIGHT), model=model)
    weights = np.where(np.asarray(valid), np.asarray(seen).sum(-1), 0.0)
    found = (weights[..., None] * pixel_grid(WIDTH, HEIGHT)).sum((0, 1)) / weights.sum()
    K_cv, R, t = for_cv(camera), np.asarray(VIEWMAT[:3, :3], np.float64), np.float64(VIEWMAT[:3, 3])
    if model == "opencv_fisheye":
        want = cv2.fisheye.projectPoints(centre[None], cv2.Rodrigues(R)[0], t, K_cv, np.float64(coeffs))[0]
    else:
        want = cv2.projectPoints(centre, cv2.Rodrigues(R)[0], t, K_cv, np.float64(coeffs))[0]
    plain, _ = project(jnp.asarray(centre, jnp.float32), VIEWMAT, camera)
    assert np.linalg.norm(want.ravel() + 0.5 - plain) > 0.5  # the lens is seen
    np.testing.assert_allclose(
        found, want.ravel() + 0.5, atol=0.1
    )  # a blob's centre is not its middle's image


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
