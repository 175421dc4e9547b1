"""Distances of features by hand, by brute force, and of all ways to split a sample."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.metrics.features import feature_psnr, mmd, video_mmd
from gsjax.perception.gabor import GaborEncoder

seeds = st.integers(0, 10_000)


@given(seeds, st.integers(2, 5), st.integers(2, 5))
def test_mmd_is_the_sum_that_is_printed(seed, n, m):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(n, 3)), rng.normal(size=(m, 3))

    def kernel(a, b):
        return (sum(a * b) / 3 + 1) ** 3

    within_x = np.mean([kernel(x[i], x[j]) for i in range(n) for j in range(n) if i != j])
    within_y = np.mean([kernel(y[i], y[j]) for i in range(m) for j in range(m) if i != j])
    between = np.mean([kernel(a, b) for a in x for b in y])
    assert mmd(x, y) == pytest.approx(within_x + within_y - 2 * between)
    assert mmd(y, x) == pytest.approx(mmd(x, y))
    assert mmd(x[rng.permutation(n)], y) == pytest.approx(mmd(x, y))


@given(seeds)
def test_over_all_ways_to_split_a_sample_the_mean_is_zero(seed):
    """This is what unbiased means, and no approximation."""
    pool = np.random.default_rng(seed).normal(size=(6, 2))
    values = [
        mmd(pool[list(chosen)], np.delete(pool, list(chosen), axis=0)) for chosen in combinations(range(6), 3)
    ]
    assert np.mean(values) == pytest.approx(0, abs=1e-9)
    assert min(values) < 0 < max(values)


def test_samples_of_other_distributions_are_far_apart():
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 80, 8))
    distances = [mmd(x, y + shift) for shift in (0.0, 0.5, 1.0, 2.0)]
    assert 3 * abs(distances[0]) < distances[1] < distances[2] < distances[3]
    assert mmd(x, 2 * y) > 0.3  # nor is it blind to more than means


def test_samples_that_cannot_be_compared_are_named():
    x = np.zeros((3, 4))
    with pytest.raises(ValueError, match=r"y: expected shape \[n, D\] with n of at least 2, found \(1, 4\)"):
        mmd(x, x[:1])
    with pytest.raises(ValueError, match="y: expected 4 features like x, found 2"):
        mmd(x, x[:, :2])


def mean_color(pictures):
    """An encoder whose features of a picture are its own."""
    return pictures.astype(np.float32) / 255


def test_videos_are_compared_by_the_means_of_their_frames():
    rng = np.random.default_rng(0)
    video, truth = (rng.integers(0, 256, (n, 5, 6, 3), dtype=np.uint8) for n in (4, 6))
    expected = mmd(video.mean((1, 2)) / 255, truth.mean((1, 2)) / 255)
    assert video_mmd(mean_color, video, truth) == pytest.approx(expected, abs=1e-6)
    assert video_mmd(mean_color, video, truth, batch=3) == pytest.approx(expected, abs=1e-6)
    with pytest.raises(ValueError, match=r"truth: expected frames \(5, 6, 3\) of uint8 like video, found"):
        video_mmd(mean_color, video, truth / 255.0)


def test_gabor_features_tell_textures_apart():
    """The same stripes elsewhere are near, finer ones are far: twice as fine as brighter."""
    x = np.arange(48)

    def stripes(wavelength, frames=4):
        waves = [0.5 + 0.3 * np.sin(2 * np.pi * (x + 3 * t) / wavelength) for t in range(frames)]
        return np.stack([np.broadcast_to(wave[None, :, None], (32, 48, 3)) for wave in waves])

    encoder = GaborEncoder()
    same, finer = (video_mmd(encoder, stripes(8), other) for other in (stripes(8)[::-1], stripes(4)))
    assert finer > 0.5
    assert abs(same) < finer / 10


@given(seeds, st.integers(1, 6))
def test_feature_psnr_follows_from_the_cosine(seed, channels):
    rng = np.random.default_rng(seed)
    features, teacher = rng.normal(size=(2, 4, 5, channels))
    cosines = np.sum(features * teacher, axis=-1) / (
        np.linalg.norm(features, axis=-1) * np.linalg.norm(teacher, axis=-1)
    )
    lengths = rng.uniform(0.1, 10, (4, 5, 1))
    if channels > 1:  # of one channel all that differ are opposite, or none
        expected = 10 * math.log10(channels / (2 - 2 * cosines.mean()))
        assert feature_psnr(features, teacher) == pytest.approx(expected)
        assert feature_psnr(lengths * features, teacher) == pytest.approx(expected)
    assert feature_psnr(lengths * features, features) > 100


def test_feature_psnr_by_hand():
    x, y = np.broadcast_to([3.0, 0, 0, 0], (2, 3, 4)), np.broadcast_to([0, 1.0, 0, 0], (2, 3, 4))
    assert feature_psnr(x, y) == pytest.approx(10 * math.log10(4 / 2))
    assert feature_psnr(x, 0 * y) == pytest.approx(10 * math.log10(4))  # what is nothing stays nothing
    assert feature_psnr(x, x) == math.inf
    mask = np.zeros((2, 3), bool)
    assert math.isnan(feature_psnr(x, y, mask))
    mask[0, 1] = True
    mixed = np.where(mask[..., None], x, y)
    assert feature_psnr(x, mixed, mask) == math.inf
    assert feature_psnr(x, mixed, ~mask) == pytest.approx(10 * math.log10(4 / 2))
    with pytest.raises(
        ValueError, match=r"teacher: expected shape \(2, 3, 4\) like features, found \(2, 3, 3\)"
    ):
        feature_psnr(x, y[..., :3])
    with pytest.raises(ValueError, match=r"mask: expected shape \(2, 3\)"):
        feature_psnr(x, y, mask[:1])
