import numpy as np
import pytest

from gsjax.methods.protocols import DenseEncoder
from gsjax.perception.gabor import GaborEncoder


@pytest.fixture(scope="module")
def stripes():
    """Grey stripes: fine in the left half, coarse in the right, with the same mean brightness."""
    x = np.arange(96)
    wave = np.where(x < 48, np.sin(2 * np.pi * x / 4), np.sin(2 * np.pi * x / 16))
    return np.broadcast_to(0.5 + 0.3 * wave[None, :, None], (64, 96, 3)).copy()


def test_texture_of_one_colour_is_told_apart(stripes):
    main = GaborEncoder()(stripes[None])[0, ..., 0]
    left, right = main[16:48, 12:36], main[16:48, 60:84]
    assert abs(left.mean() - right.mean()) > 10 * max(left.std(), right.std())


def test_it_does_not_matter_which_way_stripes_run(stripes):
    """Another camera may be rotated."""
    upright, lying = GaborEncoder()(np.stack([stripes[:, :64], stripes[:, :64].transpose(1, 0, 2)]))
    np.testing.assert_allclose(upright[20:44, 20:44], lying[20:44, 20:44].transpose(1, 0, 2), atol=1e-4)


def test_features_are_those_of_the_same_pictures_and_uncorrelated(stripes):
    pictures = np.stack([stripes, np.random.default_rng(0).uniform(size=stripes.shape)])
    encoder = GaborEncoder(num_features=5)
    assert isinstance(encoder, DenseEncoder)
    features = encoder(pictures)
    assert features.shape == (2, 64, 96, 5)
    np.testing.assert_array_equal(features, encoder(pictures))
    flat = features.reshape(-1, 5)
    correlation = np.corrcoef(flat.T)
    np.testing.assert_allclose(correlation, np.eye(5), atol=1e-3)
    assert (np.diff(flat.var(0)) <= 1e-4).all()


def test_bytes_and_floats_mean_the_same_and_nothing_is_not_finite(stripes):
    as_bytes = np.round(stripes * 255).astype(np.uint8)[None]
    np.testing.assert_allclose(GaborEncoder()(as_bytes), GaborEncoder()(as_bytes / 255.0), atol=1e-4)
    assert np.isfinite(GaborEncoder()(np.zeros((1, 20, 20, 3), np.uint8))).all()
    broken = stripes.copy()
    broken[5, 5] = np.nan
    assert np.isfinite(GaborEncoder()(broken[None])).all()
    with pytest.raises(ValueError, match="images: expected at least one, found none"):
        GaborEncoder()(np.zeros((0, 20, 20, 3)))
