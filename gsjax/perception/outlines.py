"""Outlines of masks put where a picture has an edge: a segmenter's are off by pixels, and each view's by
others."""

import cv2
import numpy as np
from jaxtyping import Float, Int, Integer, UInt8
from skimage.color import rgb2lab
from skimage.filters import sobel
from skimage.segmentation import watershed


def snap_outlines(
    labels: Integer[np.ndarray, "h w"], image: UInt8[np.ndarray, "height width 3"], reach: int = 2
) -> Int[np.ndarray, "h w"]:
    """Labels whose outlines lie on the picture's edges, where there are any within reach.

    What of a label is further than `reach` from its outline stays. What is nearer goes to the label whose
    water reaches it first, rising over the picture's gradient (CIELAB, Sobel): a watershed from markers
    (Meyer 1994, "Topographic distance and watershed lines"). A piece that is too thin to keep a core at this
    distance is eroded by less.

    Args:
        labels: negative ones, of what nobody knows, are labels like others.
        image: RGB.
        reach: pixels; 0 gives the labels back.

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
    places = places.reshape(labels.shape).astype(np.int32) + 1  # 0 is where there is no marker
    markers = np.zeros(labels.shape, np.int32)
    for place in range(1, len(known) + 1):
        markers[_cores(places == place, reach)] = place
    return known[watershed(_gradient(image), markers) - 1].astype(np.int64)


def _cores(mask: np.ndarray, reach: int) -> np.ndarray:
    """A mask eroded piece by piece, each by as much of `reach` as leaves something of it."""
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
