"""Features against features of the same pictures, pixel by pixel.

Features come from an encoder (`gsjax.methods.protocols.DenseEncoder`), and a figure is that encoder's: under
the papers' names stand only those of the papers' models. In float64, on the host.
"""

import numpy as np
from jaxtyping import Bool, Float


def feature_psnr(
    features: Float[np.ndarray, "..."],
    teacher: Float[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """f-PSNR (SurstSplat, section 4): features as pictures of many channels, each pixel's of length 1, for a
    peak of 1.

        -10 log10( mean over pixels and channels of (f / |f| - g / |g|)^2 )

    Of D channels and a mean cosine c, that is 10 log10(D / (2 - 2c)): figures of different D do not compare.
    Zeros stay zeros. Without lengths, a feature field would do well by being faint.

    Args:
        features, teacher: [..., D].
        mask: [...], True where to compare; None compares everywhere.

    Returns:
        Infinity for features of equal directions, NaN where the mask holds nothing.

    Raises:
        ValueError: the shapes do not agree.
    """
    if features.shape != teacher.shape:
        raise ValueError(f"teacher: expected shape {features.shape} like features, found {teacher.shape}")
    if mask is not None and mask.shape != features.shape[:-1]:
        raise ValueError(f"mask: expected shape {features.shape[:-1]} to match features, found {mask.shape}")
    squared = (_of_length_one(features) - _of_length_one(teacher)) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        return float("nan")
    mean = float(squared.mean())
    return float("inf") if mean == 0 else -10.0 * float(np.log10(mean))


def _of_length_one(features: np.ndarray) -> np.ndarray:
    features = np.asarray(features, np.float64)
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1.0)
