"""Masks on several levels: objects, their parts, and the parts of those. LangSplat (Qin et al. 2024, section
3.2) keeps three levels, as SAM finds them.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

Level = Literal["small", "medium", "large"]
LEVELS: tuple[Level, ...] = get_args(Level)
"""The levels, in ascending order of the size of the objects that they separate."""
_WITHIN = 0.8  # least fraction of a part that lies within the mask of the larger object


def labels_on_levels(
    masks: Bool[np.ndarray, "n H W"], max_fraction: float = 1.0, min_pixels: int = 1
) -> Int[np.ndarray, "levels H W"]:
    """A label image for each level from masks that may overlap: 1 + the row of the mask, 0 where the level
    has none. A mask that lies in no other is "large", one that lies in a large one is "medium", and all that
    are nested deeper are "small". Where masks of one level overlap, the smaller one is on top.

    Args:
        masks: masks of one image.
        max_fraction: a mask that covers more of the image is left out.
        min_pixels: a mask with fewer pixels is left out, too.
    """
    areas = masks.sum(axis=(1, 2))
    size = masks.shape[1] * masks.shape[2]
    kept = np.flatnonzero((areas >= max(min_pixels, 1)) & (areas <= max_fraction * size))
    labels = np.zeros((len(LEVELS), *masks.shape[1:]), np.int32)
    depths: dict[int, int] = {}
    for row in kept[np.argsort(-areas[kept], kind="stable")].tolist():
        around = [k for k in depths if (masks[row] & masks[k]).sum() >= _WITHIN * areas[row]]
        depths[row] = max((depths[k] + 1 for k in around), default=0)
        level = max(0, len(LEVELS) - 1 - depths[row])
        labels[level][masks[row]] = row + 1
    return labels


def labels_on_level(labels: Int[np.ndarray, "levels H W"], level: Level) -> Int[np.ndarray, "H W"]:
    """Labels on one level; where it has none, those of the nearest larger level that has one or, if none has,
    of the nearest smaller.

    Args:
        labels: on all levels; 0 where there is none.
        level: the level.
    """
    found = labels[LEVELS.index(level)].copy()
    for other in _fallbacks(LEVELS.index(level), len(labels)):
        np.copyto(found, labels[other], where=found == 0)
    return found


def joined_levels(
    ids: Sequence[Int[np.ndarray, "H W"]], codebooks: Sequence[Float[np.ndarray, "_ C"]]
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "k channels"], Bool[np.ndarray, "H W levels"]]:
    """The masks of all levels as one image of ids, whose codebook concatenates the embeddings of a pixel on
    all levels. On a level where a pixel has no mask, it takes that of the nearest larger level that has one
    or, if there is none, of the nearest smaller; the levels filled in this way are returned too.

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
        for other in _fallbacks(level, len(rows)):
            np.copyto(row, rows[other], where=row < 0)
    key = np.zeros(rows.shape[1:], np.int64)  # one number per combination, which sorts faster than rows
    for row in filled:
        key = key * (len(book) + 1) + row + 1
    combined, first, place = np.unique(key, return_index=True, return_inverse=True)
    unknown = int(combined[0] == 0) if len(combined) else 0
    codebook = book[filled.reshape(len(rows), -1)[:, first[unknown:]].T]
    codebook = codebook.reshape(len(combined) - unknown, len(rows) * book.shape[1])
    joined = (place.reshape(rows.shape[1:]) - unknown).astype(np.int32)
    return joined, codebook.astype(np.float32), np.moveaxis((rows < 0) & (filled >= 0), 0, -1)


def _fallbacks(level: int, count: int) -> Iterator[int]:
    """The levels to fall back on, in order, where one has no mask."""
    yield from range(level + 1, count)
    yield from reversed(range(level))
