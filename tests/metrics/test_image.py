"""Image metrics against scikit-image and by hand."""

import math

import numpy as np
import pytest
from scipy.signal import convolve2d
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gsjax.metrics.image import depth_error, ms_ssim, psnr, ssim, with_matched_colors


def pair(seed=0, shape=(40, 30, 3)):
    rng = np.random.default_rng(seed)
    image = rng.uniform(0, 1, shape)
    return image, np.clip(image + rng.normal(0, 0.1, shape), 0, 1)


@pytest.mark.parametrize("shape", [(40, 30, 3), (40, 30)])
def test_agree_with_scikit_image(shape):
    image, reference = pair(shape=shape)
    assert psnr(image, reference) == pytest.approx(peak_signal_noise_ratio(reference, image, data_range=1))
    axis = -1 if len(shape) == 3 else None
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    expected = structural_similarity(image, reference, channel_axis=axis, **options)
    assert ssim(image, reference) == pytest.approx(expected)


def test_equal_pictures_score_the_most():
    image, _ = pair()
    assert psnr(image, image) == math.inf
    assert ssim(image, image) == pytest.approx(1.0)


def test_a_mask_divides_by_its_own_area():
    image, reference = np.zeros((20, 20, 3)), np.zeros((20, 20, 3))
    reference[:5] = 0.1
    mask = np.zeros((20, 20), bool)
    mask[:5] = True
    assert psnr(image, reference, mask) == pytest.approx(20.0)
    assert psnr(image, reference) == pytest.approx(20.0 + 10 * math.log10(4))
    assert psnr(image, reference, ~mask) == math.inf
    assert ssim(image, reference, ~mask) > ssim(image, reference) > ssim(image, reference, mask)


def test_an_empty_mask_scores_nothing():
    image, reference = pair()
    empty = np.zeros(image.shape[:2], bool)
    assert math.isnan(psnr(image, reference, empty))
    assert math.isnan(ssim(image, reference, empty))


def test_shapes_that_do_not_agree_are_named():
    image, reference = pair()
    for metric in (psnr, ssim, ms_ssim):
        with pytest.raises(ValueError, match=r"reference: expected shape \(40, 30, 3\), found \(39, 30, 3\)"):
            metric(image, reference[1:])
        with pytest.raises(ValueError, match=r"mask: expected shape \(40, 30\) .* found \(3, 3\)"):
            metric(image, reference, np.ones((3, 3), bool))
    with pytest.raises(ValueError, match="expected at least 11 pixels"):
        ssim(image[:10], reference[:10])


def waves(shape=(176, 208, 3), seed=0):
    """Images with structure at every scale."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    sight = 0.5 + 0.3 * np.sin(x / 9) * np.cos(y / 13) + 0.1 * np.sin((x + y) / 40)
    image = np.clip(sight[..., None] * np.array([1.0, 0.8, 0.5]) + rng.normal(0, 0.05, shape), 0, 1)
    return image, np.clip(0.9 * image + 0.06 + rng.normal(0, 0.1, shape), 0, 1)


def plain_ms_ssim(x, y):
    """MS-SSIM of one channel, window by window."""
    line = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(line, line) / np.outer(line, line).sum()
    score = 1.0
    for scale, power in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        mx, my, xx, yy, xy = (convolve2d(a, window, "valid") for a in (x, y, x * x, y * y, x * y))
        similar = (2 * (xy - mx * my) + 9e-4) / (xx - mx * mx + yy - my * my + 9e-4)
        if scale == 4:
            similar = similar * (2 * mx * my + 1e-4) / (mx * mx + my * my + 1e-4)
        score *= similar.mean() ** power
        rows, columns = (np.minimum(np.arange(side + side % 2), side - 1) for side in x.shape)
        x, y = (
            a[rows][:, columns].reshape(len(rows) // 2, 2, len(columns) // 2, 2).mean((1, 3)) for a in (x, y)
        )
    return score


@pytest.mark.parametrize("shape", [(176, 208, 3), (161, 175, 3)])
def test_ms_ssim_agrees_with_a_plain_one(shape):
    image, reference = waves(shape)
    expected = [plain_ms_ssim(image[..., c], reference[..., c]) for c in range(3)]
    assert ms_ssim(image, reference) == pytest.approx(np.mean(expected), abs=1e-12)
    assert ms_ssim(image[..., 1], reference[..., 1]) == pytest.approx(expected[1], abs=1e-12)
    assert 0.5 < np.mean(expected) < 0.99
    assert ms_ssim(image, image) == pytest.approx(1.0)


def test_ms_ssim_under_a_mask():
    image, reference = waves()
    reference[:, 104:] = image[:, 104:]
    left = np.zeros(image.shape[:2], bool)
    left[:, :90] = True
    right = np.zeros(image.shape[:2], bool)
    right[:, 200:] = True
    everywhere = np.ones(image.shape[:2], bool)
    assert ms_ssim(image, reference, left) < ms_ssim(image, reference, everywhere) < 1
    assert ms_ssim(image, reference, right) == pytest.approx(1.0, abs=1e-3)
    assert ms_ssim(image, reference, everywhere) == pytest.approx(ms_ssim(image, reference), abs=0.02)
    assert math.isnan(ms_ssim(image, reference, ~everywhere))
    spoiled = image.copy()
    spoiled[:40, 200:] = 0.5  # outside the mask, and part of a pixel at the coarsest scale
    assert ms_ssim(spoiled, reference, left) == pytest.approx(ms_ssim(image, reference, left), abs=1e-9)


def test_ms_ssim_of_opposite_pictures_is_zero_and_small_ones_are_refused():
    image, _ = waves()
    assert ms_ssim(image, 1 - image) == 0
    for shape in ((160, 300), (300, 160, 3)):
        with pytest.raises(ValueError, match=r"expected at least 161 pixels on each side"):
            ms_ssim(np.zeros(shape), np.zeros(shape))


def test_depth_error_counts_valid_pixels_only():
    reference = np.full((4, 5), 1.0)
    depth = reference + 0.005
    depth[0] += 0.015  # 20 mm off
    depth[1, 0], depth[1, 1], reference[1, 2] = 0.0, np.nan, 0.0
    error = depth_error(depth, reference)
    assert error.num_pixels == 17
    assert error.mean_abs_mm == pytest.approx((5 * 20 + 12 * 5) / 17)
    assert error.within_1cm == pytest.approx(12 / 17)
    first_row = np.zeros((4, 5), bool)
    first_row[0] = True
    assert depth_error(depth, reference, first_row).mean_abs_mm == pytest.approx(20)
    assert math.isnan(depth_error(0 * depth, reference).mean_abs_mm)
    with pytest.raises(ValueError, match="mask: expected shape"):
        depth_error(depth, reference, first_row[1:])


def test_a_difference_in_exposure_and_white_balance_can_be_taken_away():
    random = np.random.default_rng(0)
    target = random.uniform(0.2, 0.8, (20, 30, 3))
    tinted = target @ np.array([[0.8, 0.05, 0], [0, 0.9, 0], [0.02, 0, 0.7]]) + np.array([0.05, 0, 0.1])
    np.testing.assert_allclose(with_matched_colors(tinted, target), target, atol=1e-9)
    mask = np.zeros((20, 30), bool)
    mask[:, :10] = True
    spoilt = np.where(mask[..., None], tinted, random.uniform(size=target.shape))
    np.testing.assert_allclose(with_matched_colors(spoilt, target, mask)[mask], target[mask], atol=1e-9)
