"""Masks on several levels: things, their parts, and the parts of these, as SAM finds them and LangSplat (Qin
et al. 2024, section 3.2) learns them.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

LEVELS = ("small", "medium", "large")
"""Levels by the size of what they hold apart."""


def labels_on_levels(
    masks: Bool[np.ndarray, "n H W"], max_fraction: float = 1.0
) -> Int[np.ndarray, "levels H W"]:
    """A label image for each level from masks that may overlap: 0 for background, 1 + the row of the mask
    elsewhere. Of the masks that cover a pixel, the smallest is its label on the level "small", the largest on
    "large" and, on "medium", the one half-way between them, of two the larger.

    Args:
        masks: masks of one image.
        max_fraction: a mask that covers more of the image is left out.
    """
    areas = masks.sum(axis=(1, 2))
    kept = np.flatnonzero((areas > 0) & (areas <= max_fraction * masks[0].size if len(masks) else True))
    order = kept[np.argsort(areas[kept], kind="stable")]
    labels = np.zeros((len(LEVELS), *masks.shape[1:]), np.int32)
    count = masks[order].sum(axis=0)
    wanted = np.stack([np.zeros_like(count), count // 2, count - 1])  # places among those that cover a pixel
    below = np.zeros_like(count)
    for row in order:
        labels[masks[row] & (below == wanted)] = row + 1
        below += masks[row]
    return labels


def joined_levels(
    ids: Sequence[Int[np.ndarray, "H W"]], codebooks: Sequence[Float[np.ndarray, "_ C"]]
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "k channels"]]:
    """The masks of all levels as one image of ids: its codebook has the embeddings of a pixel on all levels,
    one after another. On a level where a pixel has no mask it has that of the next larger level or, without
    one, of the next smaller.

    Args:
        ids: row of the level's codebook for each pixel; -1 where there is none. The smallest level is first.
        codebooks: embeddings of each level; a row of zeros is unknown.
    """
    book = np.concatenate(codebooks)
    starts = np.cumsum([0, *(len(each) for each in codebooks)])[:-1]
    known = np.append(book.any(axis=1), False)
    rows = np.stack([np.where(each >= 0, each + start, -1) for each, start in zip(ids, starts, strict=True)])
    rows = np.where(known[rows], rows, -1)
    filled = rows.copy()
    for level, row in enumerate(filled):
        for other in (*range(level + 1, len(rows)), *range(level)[::-1]):
            np.copyto(row, rows[other], where=row < 0)
    combined, place = np.unique(filled.reshape(len(rows), -1).T, axis=0, return_inverse=True)
    unknown = int(combined[0, 0] < 0) if len(combined) else 0
    codebook = book[combined[unknown:]].reshape(len(combined) - unknown, -1)
    return (place.reshape(rows.shape[1:]) - unknown).astype(np.int32), codebook.astype(np.float32)
