"""Rendered features against an encoder's features of the same images, pixel by pixel.

Features come from an encoder (`gsjax.methods.protocols.DenseEncoder`), and scores are specific to it: only
those of the papers' models are reported under the papers' names. In float64, on the host.
"""

import numpy as np
from jaxtyping import Bool, Float


def feature_psnr(
    features: Float[np.ndarray, "..."],
    teacher: Float[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """f-PSNR (SurstSplat, section 3): PSNR of feature maps with a peak of 1, after scaling each pixel's
    feature to unit length.

        -10 log10( mean over pixels and channels of (f / |f| - g / |g|)^2 )

    For D channels and a mean cosine c, that is 10 log10(D / (2 - 2c)), so scores of different D are not
    comparable. Zeros stay zeros. Without the normalisation, a feature field could score well by being faint.

    Args:
        features, teacher: [..., D].
        mask: [...], True where to compare; None compares everywhere.

    Returns:
        Infinity for features of equal direction, NaN if the mask is empty.

    Raises:
        ValueError: the shapes do not agree.
    """
    if features.shape != teacher.shape:
        raise ValueError(f"teacher: expected shape {features.shape} to match features, found {teacher.shape}")
    if mask is not None and mask.shape != features.shape[:-1]:
        raise ValueError(f"mask: expected shape {features.shape[:-1]} to match features, found {mask.shape}")
    squared = (_normalized(features) - _normalized(teacher)) ** 2
    if mask is not None:
        squared = squared[mask]
    if squared.size == 0:
        return float("nan")
    mean = float(squared.mean())
    return float("inf") if mean == 0 else -10.0 * float(np.log10(mean))


def _normalized(features: np.ndarray) -> np.ndarray:
    features = np.asarray(features, np.float64)
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1.0)
