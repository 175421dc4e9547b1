"""Combine overlapping masks into one label image, with labels ordered by size."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int


class Detections(NamedTuple):
    """Output of a detector or segmenter, before it is combined into labels."""

    boxes: Float[np.ndarray, "n 4"]  # x0, y0, x1, y1 in pixels
    scores: Float[np.ndarray, "n"]  # confidence of each box, 0 to 1
    masks: Bool[np.ndarray, "n H W"]


def labels_of_masks(
    masks: Bool[np.ndarray, "n H W"],
    scores: Float[np.ndarray, "n"],
    max_fraction: float = 1.0,
    max_overlap: float = 1.0,
) -> Int[np.ndarray, "H W"]:
    """One label image from masks that may overlap: 0 for background, 1 + the row of the mask elsewhere.

    A mask that covers more than `max_fraction` of the image is left out, and so is one that overlaps a mask
    of higher score by more than `max_overlap` (intersection over union). Where masks overlap, the smaller one
    is on top, as an object is on its tray.

    Args:
        masks: masks of one image.
        scores: confidence of each mask.
        max_fraction: largest share of the image, 0 to 1.
        max_overlap: largest intersection over union, 0 to 1.
    """
    kept: list[int] = []
    for row in np.argsort(-scores, kind="stable"):
        mask = masks[row]
        overlaps = [(mask & masks[k]).sum() / max((mask | masks[k]).sum(), 1) for k in kept]
        if 0 < mask.mean() <= max_fraction and max(overlaps, default=0.0) <= max_overlap:
            kept.append(int(row))
    labels = np.zeros(masks.shape[1:], np.int32)
    for row in sorted(kept, key=lambda k: -int(masks[k].sum())):
        labels[masks[row]] = row + 1
    return labels


def name_by_size(
    labels: Int[np.ndarray, "H W"], min_pixels: int = 1, background: int = 0
) -> Int[np.ndarray, "H W"]:
    """Renumber labels 1, 2, ... from the largest to the smallest; those with fewer than `min_pixels` become
    0.

    Args:
        labels: any integers.
        min_pixels: smallest area of a label that is kept, pixels.
        background: the label that becomes 0, whatever its size.
    """
    names, inverse, counts = np.unique(labels, return_inverse=True, return_counts=True)
    kept = np.flatnonzero((names != background) & (counts >= min_pixels))
    renamed = np.zeros(len(names), np.int32)
    # A stable sort, so that components of equal size keep their order in the image.
    renamed[kept[np.argsort(-counts[kept], kind="stable")]] = np.arange(1, len(kept) + 1)
    return renamed[inverse].reshape(labels.shape)
