"""Image losses against scikit-image, plain numpy and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage.metrics import structural_similarity

from gsjax.losses.photometric import l1_loss, photometric_loss, ssim, truncated_l1, weighted_mean


def images(seed: int, shape=(2, 20, 24, 3), noise: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
    """An image with some structure and a noisy copy, values 0 to 1."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[0 : shape[1], 0 : shape[2]]
    waves = np.sin(rows / 3.0)[..., None] * np.cos(columns / 4.0)[..., None] * np.array([0.3, 0.2, 0.4])
    image = np.clip(0.5 + waves + 0.05 * rng.normal(size=shape), 0, 1)
    return image, np.clip(image + noise * rng.normal(size=shape), 0, 1)


def test_weighted_mean_is_numpys_average_and_zero_without_weight():
    rng = np.random.default_rng(0)
    values, weights = rng.normal(size=(4, 5)), rng.uniform(size=(4, 5))
    expected = np.average(values, weights=weights)
    np.testing.assert_allclose(weighted_mean(jnp.asarray(values), jnp.asarray(weights)), expected, rtol=1e-5)
    assert weighted_mean(jnp.ones(3), jnp.zeros(3)) == 0


def test_l1_averages_over_channels_and_pixels_and_follows_the_weights():
    image, target = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    image[0, 0], image[1, 1] = [0.3, 0.6, 0.0], [1.0, 1.0, 1.0]
    image, target = jnp.asarray(image), jnp.asarray(target)
    np.testing.assert_allclose(l1_loss(image, target), (0.3 + 1.0) / 4, rtol=1e-6)
    weights = jnp.array([[1.0, 0.5], [0.5, 0.0]])
    np.testing.assert_allclose(l1_loss(image, target, weights), 0.3 / 2, rtol=1e-6)
    assert l1_loss(image, target, jnp.zeros((2, 2))) == 0


def test_truncated_l1_counts_large_differences_as_the_limit_without_gradient():
    values, targets = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.02, 2.5, 3.0])
    weights = jnp.array([1.0, 1.0, 0.0])
    loss, gradient = jax.value_and_grad(truncated_l1)(values, targets, weights, 0.05)
    np.testing.assert_allclose(loss, (0.02 + 0.05) / 2, rtol=1e-4)
    np.testing.assert_allclose(gradient, [-0.5, 0.0, 0.0], atol=1e-6)


def test_zero_weights_leave_zero_gradients():
    values = jnp.array([0.2, 0.7])
    gradient = jax.jit(jax.grad(lambda v: truncated_l1(v, jnp.zeros(2), jnp.zeros(2), 0.5)))(values)
    np.testing.assert_array_equal(gradient, 0)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("shape", [(1, 120, 160, 3), (1, 13, 11, 3)])
def test_ssim_is_scikit_images(shape):
    image, target = images(0, shape)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = structural_similarity(image[0], target[0], channel_axis=-1, **options)
    assert 0.1 < expected < 0.9
    np.testing.assert_allclose(ssim(jnp.asarray(image), jnp.asarray(target)), expected, atol=1e-12)


@pytest.mark.usefixtures("x64")
def test_ssim_of_an_image_smaller_than_its_window_is_that_of_one_with_a_black_border():
    image, target = images(2, (1, 6, 9, 3))
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    wide = [np.pad(a[0], ((20, 20), (20, 20), (0, 0))) for a in (image, target)]
    _, scores = structural_similarity(*wide, channel_axis=-1, full=True, **options)
    expected = scores[20:-20, 20:-20].mean()
    np.testing.assert_allclose(ssim(jnp.asarray(image), jnp.asarray(target)), expected, atol=1e-12)


def test_ssim_of_equal_images_is_one_and_it_is_symmetric():
    image, target = map(jnp.asarray, images(3))
    np.testing.assert_allclose(ssim(image, image), 1.0, atol=1e-5)
    np.testing.assert_allclose(ssim(image, target), ssim(target, image), rtol=1e-5)
    assert photometric_loss(image, image) < 1e-5


def test_photometric_loss_mixes_l1_and_dssim():
    image, target = map(jnp.asarray, images(4))
    expected = 0.7 * l1_loss(image, target) + 0.3 * (1 - ssim(image, target)) / 2
    np.testing.assert_allclose(photometric_loss(image, target, 0.3), expected, rtol=1e-5)
    np.testing.assert_allclose(photometric_loss(image, target, 0.0), l1_loss(image, target), rtol=1e-5)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("loss", [l1_loss, ssim, photometric_loss], ids=lambda f: f.__name__)
def test_gradients_are_those_of_central_differences(loss):
    rng = np.random.default_rng(5)  # not clipped: L1 has a kink where both are 0
    both = tuple(jnp.asarray(rng.uniform(size=(2, 2, 13, 15, 3))))
    directions = tuple(jnp.asarray(np.random.default_rng(6).normal(size=(2, 2, 13, 15, 3))))
    step = 1e-6
    for which in ((1, 0), (0, 1), (1, 1)):  # a change of the image, of the target, of both
        change = [share * direction for share, direction in zip(which, directions, strict=True)]
        ahead = loss(*(a + step * d for a, d in zip(both, change, strict=True)))
        behind = loss(*(a - step * d for a, d in zip(both, change, strict=True)))
        expected = (ahead - behind) / (2 * step)
        slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(*both)
        slope = sum(jnp.vdot(a, d) for a, d in zip(slopes, change, strict=True))
        np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(jax.jvp(loss, both, tuple(change))[1], slope, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_ssim_is_the_same_under_jit_and_vmap():
    image, target = map(jnp.asarray, images(4, (3, 14, 15, 3)))
    together = jax.jit(jax.vmap(ssim))(image[:, None], target[:, None])
    alone = [ssim(image[i : i + 1], target[i : i + 1]) for i in range(3)]
    np.testing.assert_allclose(together, alone, rtol=1e-5)
    slopes = jax.vmap(jax.grad(ssim))(image[:, None], target[:, None])
    np.testing.assert_allclose(slopes[1], jax.jit(jax.grad(ssim))(image[1:2], target[1:2]), atol=1e-6)
