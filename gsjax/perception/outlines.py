"""Snap the outlines of masks to edges of the image. A segmenter's outlines are off by a few pixels,
differently in each view."""

import cv2
import numpy as np
from jaxtyping import Float, Int, Integer, UInt8
from skimage.color import rgb2lab
from skimage.filters import sobel
from skimage.segmentation import watershed


def snap_outlines(
    labels: Integer[np.ndarray, "h w"], image: UInt8[np.ndarray, "height width 3"], reach: int = 2
) -> Int[np.ndarray, "h w"]:
    """Labels whose outlines lie on edges of the image, where there are any within reach.

    Pixels farther than `reach` from the outline of their label keep it. The others are assigned by a
    watershed of the image's gradient (CIELAB, Sobel), with these cores as markers (Meyer 1994, "Topographic
    distance and watershed lines"). A piece too thin to keep a core at this distance is eroded by less.

    Args:
        labels: integer labels; a negative label (unknown) is treated like any other.
        image: RGB.
        reach: largest shift of an outline, pixels; 0 returns the labels unchanged.

    Raises:
        ValueError: shapes differ, or the reach is negative.
    """
    if labels.shape != image.shape[:2]:
        raise ValueError(f"labels: expected {image.shape[:2]} pixels like the image, found {labels.shape}")
    if reach < 0:
        raise ValueError(f"reach: expected 0 or more pixels, found {reach}")
    if reach == 0:
        return labels.astype(np.int64)
    known, places = np.unique(labels, return_inverse=True)
    places = places.reshape(labels.shape).astype(np.int32) + 1  # 0 marks pixels without a marker
    markers = np.zeros(labels.shape, np.int32)
    for place in range(1, len(known) + 1):
        markers[_cores(places == place, reach)] = place
    return known[watershed(_gradient(image), markers) - 1].astype(np.int64)


def _cores(mask: np.ndarray, reach: int) -> np.ndarray:
    """A mask eroded piece by piece, each by the largest radius up to `reach` that leaves a core."""
    cores, left = np.zeros_like(mask), mask
    for radius in range(reach, 0, -1):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
        core = cv2.erode(left.astype(np.uint8), kernel, borderValue=1) > 0
        _, pieces = cv2.connectedComponents(left.astype(np.uint8))
        cores |= core
        left = left & ~np.isin(pieces, np.unique(pieces[core]))
    return cores | left


def _gradient(image: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    lab = rgb2lab(image)
    return np.sqrt(sum(sobel(lab[..., channel]) ** 2 for channel in range(3)))
