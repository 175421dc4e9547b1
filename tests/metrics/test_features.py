"""f-PSNR computed by hand, and from the cosine."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.metrics.features import feature_psnr

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(1, 6))
def test_feature_psnr_follows_from_the_cosine(seed, channels):
    rng = np.random.default_rng(seed)
    features, teacher = rng.normal(size=(2, 4, 5, channels))
    cosines = np.sum(features * teacher, axis=-1) / (
        np.linalg.norm(features, axis=-1) * np.linalg.norm(teacher, axis=-1)
    )
    lengths = rng.uniform(0.1, 10, (4, 5, 1))
    if channels > 1:  # with one channel, features are equal or opposite
        expected = 10 * math.log10(channels / (2 - 2 * cosines.mean()))
        assert feature_psnr(features, teacher) == pytest.approx(expected)
        assert feature_psnr(lengths * features, teacher) == pytest.approx(expected)
    assert feature_psnr(lengths * features, features) > 100


def test_feature_psnr_by_hand():
    x, y = np.broadcast_to([3.0, 0, 0, 0], (2, 3, 4)), np.broadcast_to([0, 1.0, 0, 0], (2, 3, 4))
    assert feature_psnr(x, y) == pytest.approx(10 * math.log10(4 / 2))
    assert feature_psnr(x, 0 * y) == pytest.approx(10 * math.log10(4))  # zeros stay zeros
    assert feature_psnr(x, x) == math.inf
    mask = np.zeros((2, 3), bool)
    assert math.isnan(feature_psnr(x, y, mask))
    mask[0, 1] = True
    mixed = np.where(mask[..., None], x, y)
    assert feature_psnr(x, mixed, mask) == math.inf
    assert feature_psnr(x, mixed, ~mask) == pytest.approx(10 * math.log10(4 / 2))
    with pytest.raises(
        ValueError, match=r"teacher: expected shape \(2, 3, 4\) to match features, found \(2, 3, 3\)"
    ):
        feature_psnr(x, y[..., :3])
    with pytest.raises(ValueError, match=r"mask: expected shape \(2, 3\)"):
        feature_psnr(x, y, mask[:1])
