"""How near a rendered picture and its depth are to the recorded ones. All on the host, in float64."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Num
from skimage.metrics import structural_similarity

_SSIM_WINDOW = 11  # 3.5 sigma on either side of a Gaussian of sigma 1.5, as Wang et al. (2004)


def psnr(
    image: Num[np.ndarray, "..."],
    reference: Num[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB, for a peak of 1.

        -10 log10( sum over mask and channels of (image - reference)^2 / (channels * area of mask) )

    It divides by the mask's own area: dividing by all pixels would credit those that nobody compared.

    Args:
        image, reference: [H, W] or [H, W, channels], 0 to 1.
        mask: [H, W], True where to compare; None compares everywhere.

    Returns:
        Infinity for equal pictures, NaN where the mask holds no pixel.

    Raises:
        ValueError: the shapes do not agree.
    """
    image, reference = _same_shape(image, reference)
    squared = (image - reference) ** 2
    if mask is not None:
        mask = np.asarray(mask)
        if mask.shape != image.shape[:2]:
            raise ValueError(f"mask: got shape {mask.shape}, want {image.shape[:2]} to match image")
        squared = squared[mask]
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

    With a mask, the mean of the similarity map over its pixels; their windows do reach beyond it.

    Args:
        image, reference: [H, W] or [H, W, channels], 0 to 1, at least 11 pixels on each side.
        mask: [H, W], True where to compare.

    Returns:
        NaN where the mask holds no pixel.

    Raises:
        ValueError: the shapes do not agree, or the picture is smaller than the window.
    """
    image, reference = _same_shape(image, reference)
    if min(image.shape[:2]) < _SSIM_WINDOW:
        raise ValueError(f"image: got {image.shape[:2]} pixels, want at least 11 on each side for SSIM")
    mean, similarity = structural_similarity(
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
    mask = np.asarray(mask)
    if mask.shape != image.shape[:2]:
        raise ValueError(f"mask: got shape {mask.shape}, want {image.shape[:2]} to match image")
    return float(np.mean(similarity[mask])) if mask.any() else float("nan")


class DepthError(NamedTuple):
    """How far depth is off, over the pixels where both it and the truth are valid.

    Attributes:
        mean_abs_mm: mean of |depth - reference|, millimetres; NaN without a valid pixel.
        within_1cm: fraction of the pixels that are off by at most 10 mm; NaN without a valid pixel.
        num_pixels: how many pixels were compared.
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
        if np.shape(mask) != depth.shape:
            raise ValueError(f"mask: got shape {np.shape(mask)}, want {depth.shape} to match depth")
        valid &= mask
    if not valid.any():
        return DepthError(float("nan"), float("nan"), 0)
    gap = np.abs(depth[valid] - reference[valid])
    return DepthError(1000.0 * float(gap.mean()), float(np.mean(gap <= 0.01)), int(valid.sum()))


def _same_shape(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both in float64, or a ValueError that says how they differ."""
    if np.shape(image) != np.shape(reference):
        raise ValueError(f"reference: got shape {np.shape(reference)}, want {np.shape(image)} like the other")
    return np.asarray(image, np.float64), np.asarray(reference, np.float64)
