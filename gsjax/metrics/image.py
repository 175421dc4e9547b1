"""Scores of rendered images and depths against recorded ones. On the host, in float64."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity

_SSIM_WINDOW = 11  # 3.5 sigma on either side of a Gaussian of sigma 1.5, as Wang et al. (2004)
_MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # per scale, finest first: Wang et al. (2003)
MS_SSIM_LEAST_SIDE = (_SSIM_WINDOW - 1) * 2 ** (len(_MS_SSIM_WEIGHTS) - 1) + 1
"""Smallest side, in pixels, at which the coarsest scale of MS-SSIM still holds a window."""


def psnr(
    image: Num[np.ndarray, "..."],
    reference: Num[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB, for a peak of 1.

        -10 log10( sum over mask and channels of (image - reference)^2 / (channels * area of mask) )

    The divisor is the area of the mask: dividing by all pixels would credit those that were not compared.

    Args:
        image, reference: [H, W] or [H, W, channels], 0 to 1.
        mask: [H, W], True where to compare; None compares everywhere.

    Returns:
        Infinity for equal images, NaN if the mask is empty.

    Raises:
        ValueError: the shapes do not agree.
    """
    image, reference = _same_shape(image, reference)
    squared = (image - reference) ** 2
    if mask is not None:
        squared = squared[_checked(mask, image)]
    if squared.size == 0:
        return float("nan")
    mean = float(np.mean(squared))
    return float("inf") if mean == 0 else -10.0 * float(np.log10(mean))


def ssim(
    image: Num[np.ndarray, "..."],
    reference: Num[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """Structural similarity (Wang et al. 2004): Gaussian window of sigma 1.5, data range 1, -1 to 1.

    With a mask, the mean of the similarity map over its pixels; their windows still reach beyond it.

    Args:
        image, reference: [H, W] or [H, W, channels], 0 to 1, at least 11 pixels on each side.
        mask: [H, W], True where to compare.

    Returns:
        NaN if the mask is empty.

    Raises:
        ValueError: the shapes do not agree, or the image is smaller than the window.
    """
    image, reference = _same_shape(image, reference)
    if min(image.shape[:2]) < _SSIM_WINDOW:
        raise ValueError(f"image: expected at least 11 pixels on each side for SSIM, found {image.shape[:2]}")
    mean, similarity, *_ = structural_similarity(
        image,
        reference,
        data_range=1.0,
        channel_axis=-1 if image.ndim == 3 else None,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    if mask is None:
        return float(mean)
    mask = _checked(mask, image)
    return float(np.mean(similarity[mask])) if mask.any() else float("nan")


def with_matched_colors(
    image: Float[np.ndarray, "height width 3"],
    target: Float[np.ndarray, "height width 3"],
    mask: Bool[np.ndarray, "height width"] | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """The image after the affine map of its colours that fits the target best, by least squares; this removes
    differences in exposure and white balance.

    Args:
        image: colours 0 to 1.
        target: the image to match.
        mask: pixels used to fit the map, which is then applied to all; default: all.
    """
    counted = np.ones(image.shape[:2], bool) if mask is None else mask
    colors = np.concatenate([image[counted], np.ones((int(counted.sum()), 1))], axis=1)
    map_ = np.linalg.lstsq(colors, target[counted], rcond=None)[0]
    return np.clip(image @ map_[:3] + map_[3], 0, 1)


def ms_ssim(
    image: Num[np.ndarray, "..."],
    reference: Num[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """Multi-scale structural similarity (Wang, Simoncelli, Bovik 2003), per channel and then averaged.

        cs_1^0.0448 cs_2^0.2856 cs_3^0.3001 cs_4^0.2363 (l_5 cs_5)^0.1333

    l compares luminance, cs contrast and structure, each in the window of `ssim`. Each scale averages the one
    before over blocks of 2x2 pixels, repeating the last row or column where a side is odd. A scale on which
    the images are anticorrelated counts as 0, since a negative number has no such power.

    With a mask, means over a scale's pixels are weighted by the fraction of each that the mask covers; their
    windows still reach beyond it.

    Args:
        image, reference: [H, W] or [H, W, channels], 0 to 1, at least 161 pixels on each side.
        mask: [H, W], True where to compare.

    Returns:
        NaN if the mask is empty.

    Raises:
        ValueError: the shapes do not agree, or the image is too small for five scales.
    """
    image, reference = _same_shape(image, reference)
    weights = None if mask is None else _checked(mask, image).astype(np.float64)
    if min(image.shape[:2]) < MS_SSIM_LEAST_SIDE:
        raise ValueError(
            f"image: expected at least {MS_SSIM_LEAST_SIDE} pixels on each side for the five scales of "
            f"MS-SSIM, found {image.shape[:2]}"
        )
    if weights is not None and not weights.any():
        return float("nan")
    x, y = (a.reshape(*a.shape[:2], -1) for a in (image, reference))
    score, last = np.ones(x.shape[-1]), len(_MS_SSIM_WEIGHTS) - 1
    for scale, power in enumerate(_MS_SSIM_WEIGHTS):
        luminance, contrast = _similarity(x, y)
        similar = luminance * contrast if scale == last else contrast
        score *= np.maximum(_mean(similar, weights), 0) ** power
        x, y = _halved(x), _halved(y)
        weights = None if weights is None else _halved(weights)
    return float(score.mean())


def _similarity(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Per pixel: similarity of luminance, and of contrast and structure (Wang et al. 2004, eq. 6, 9, 10)."""
    c1, c2 = 0.01**2, 0.03**2

    def blurred(a: np.ndarray) -> np.ndarray:
        return gaussian_filter(a, 1.5, truncate=3.5, axes=(0, 1))

    mx, my = blurred(x), blurred(y)
    xx, yy, xy = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    return (2 * mx * my + c1) / (mx**2 + my**2 + c1), (2 * xy + c2) / (xx + yy + c2)


def _mean(values: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    """Mean per channel: over the pixels whose window lies within the image, or weighted over all pixels."""
    if weights is not None:
        return np.tensordot(weights, values, axes=2) / weights.sum()
    half = _SSIM_WINDOW // 2
    return values[half:-half, half:-half].mean(axis=(0, 1))


def _halved(a: np.ndarray) -> np.ndarray:
    """Means of 2x2 pixels."""
    even = np.pad(a, [(0, side % 2) for side in a.shape[:2]] + [(0, 0)] * (a.ndim - 2), mode="edge")
    return (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4


class DepthError(NamedTuple):
    """Error of a depth image, over the pixels where both it and the reference are valid.

    Attributes:
        mean_abs_mm: mean of |depth - reference|, millimetres; NaN if no pixel is valid.
        within_1cm: fraction of the pixels with an error of at most 10 mm; NaN if no pixel is valid.
        num_pixels: number of pixels compared.
    """

    mean_abs_mm: float
    within_1cm: float
    num_pixels: int


def depth_error(
    depth: Float[np.ndarray, "..."],
    reference: Float[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> DepthError:
    """Compare z-depth in metres where both are positive and finite (and `mask` is True).

    Args:
        depth, reference: [H, W], metres; 0 is invalid.
        mask: [H, W], True where to compare.

    Raises:
        ValueError: the shapes do not agree.
    """
    depth, reference = _same_shape(depth, reference)
    valid = np.isfinite(depth) & np.isfinite(reference) & (depth > 0) & (reference > 0)
    if mask is not None:
        valid &= _checked(mask, depth, "depth")
    if not valid.any():
        return DepthError(float("nan"), float("nan"), 0)
    gap = np.abs(depth[valid] - reference[valid])
    return DepthError(1000.0 * float(gap.mean()), float(np.mean(gap <= 0.01)), int(valid.sum()))


def _same_shape(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both as float64; raises ValueError if their shapes differ."""
    if np.shape(image) != np.shape(reference):
        raise ValueError(f"reference: expected shape {np.shape(image)}, found {np.shape(reference)}")
    return np.asarray(image, np.float64), np.asarray(reference, np.float64)


def _checked(mask: np.ndarray, picture: np.ndarray, name: str = "image") -> np.ndarray:
    """The mask; raises ValueError unless it has the image's height and width."""
    if np.shape(mask) != picture.shape[:2]:
        raise ValueError(f"mask: expected shape {picture.shape[:2]} to match {name}, found {np.shape(mask)}")
    return np.asarray(mask)
