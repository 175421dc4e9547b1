"""Picture metrics against scikit-image and by hand."""

import math

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from gsjax.metrics.image import depth_error, psnr, ssim


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
    for metric in (psnr, ssim):
        with pytest.raises(ValueError, match=r"reference: got shape \(39, 30, 3\), want \(40, 30, 3\)"):
            metric(image, reference[1:])
        with pytest.raises(ValueError, match=r"mask: got shape \(3, 3\), want \(40, 30\)"):
            metric(image, reference, np.ones((3, 3), bool))
    with pytest.raises(ValueError, match="at least 11"):
        ssim(image[:10], reference[:10])


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
    with pytest.raises(ValueError, match="mask: got shape"):
        depth_error(depth, reference, first_row[1:])
