"""Features against features: of the same pictures, pixel by pixel; of two videos, as samples.

Features come from an encoder (`gsjax.methods.protocols.DenseEncoder`), and a figure is that encoder's: under
the papers' names stand only those of the papers' models. In float64, on the host.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Num

_DEGREE = 3  # of the polynomial kernel


def feature_psnr(
    features: Float[np.ndarray, "..."],
    teacher: Float[np.ndarray, "..."],
    mask: Bool[np.ndarray, "..."] | None = None,
) -> float:
    """f-PSNR (papers/003, section 4): features as pictures of many channels, each pixel's of length 1, for a
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


def mmd(x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> float:
    """Squared maximum mean discrepancy of two samples, unbiased, for k(a, b) = (a . b / D + 1)^3.

        mean_(i != j) k(x_i, x_j) + mean_(i != j) k(y_i, y_j) - 2 mean_(i, j) k(x_i, y_j)

    The kernel is that of Binkowski et al., "Demystifying MMD GANs" (ICLR 2018), of which Unterthiner et al.
    (2018) made the kernel video distance. For samples of one distribution it is 0 on average, and negative as
    often as not.

    Args:
        x, y: [n, D] and [m, D], with at least two of each.

    Raises:
        ValueError: the shapes are others.
    """
    for name, sample in (("x", x), ("y", y)):
        if sample.ndim != 2 or len(sample) < 2:
            raise ValueError(f"{name}: expected shape [n, D] with n of at least 2, found {sample.shape}")
    if x.shape[1] != y.shape[1]:
        raise ValueError(f"y: expected {x.shape[1]} features like x, found {y.shape[1]}")
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    return _mean_of_others(_kernel(x, x)) + _mean_of_others(_kernel(y, y)) - 2 * float(_kernel(x, y).mean())


def video_mmd(
    encoder: Callable[[np.ndarray], np.ndarray],
    video: Num[np.ndarray, "..."],
    truth: Num[np.ndarray, "..."],
    batch: int | None = None,
) -> float:
    """How unlike the frames of two videos are: `mmd` of their features, each frame's the mean over pixels.

    With DINOv2 it is KVD as in papers/001, section 4.1: an edited video against the recording. With
    `GaborEncoder` it says how far texture and colour differ, and is the MMD of Gabor features. Frames that
    follow each other are no independent samples: two halves of one video are further apart than 0.

    Args:
        encoder: pictures [C, H, W, 3] to features [C, H, W, D].
        video, truth: [T, H, W, 3] and [U, H, W, 3], RGB, uint8 or floats 0 to 1.
        batch: frames that the encoder sees at once; None shows it both videos together. Fewer only for one
            whose features of a picture do not depend on the others' (DINOv2; not the PCA of Gabor features).

    Raises:
        ValueError: sizes or types of the frames differ, or there are fewer than two of one.
    """
    if video.shape[1:] != truth.shape[1:] or video.dtype != truth.dtype:
        raise ValueError(
            f"truth: expected frames {video.shape[1:]} of {video.dtype} like video, "
            f"found {truth.shape[1:]} of {truth.dtype}"
        )
    frames = np.concatenate([video, truth])
    step = batch or len(frames)
    features = np.concatenate(
        [
            encoder(frames[i : i + step]).mean(axis=(1, 2), dtype=np.float64)
            for i in range(0, len(frames), step)
        ]
    )
    return mmd(features[: len(video)], features[len(video) :])


def _of_length_one(features: np.ndarray) -> np.ndarray:
    features = np.asarray(features, np.float64)
    length = np.linalg.norm(features, axis=-1, keepdims=True)
    return features / np.where(length > 0, length, 1.0)


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x @ y.T / x.shape[1] + 1) ** _DEGREE


def _mean_of_others(kernel: np.ndarray) -> float:
    """The mean of what is not on the diagonal."""
    n = len(kernel)
    return float(kernel.sum() - np.trace(kernel)) / (n * (n - 1))
