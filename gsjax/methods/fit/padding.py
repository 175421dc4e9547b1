"""Common sizes for photographs of many sizes: each size costs three compiled programs. On the host."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from gsjax.scene.frame import Frame

_MOST = 2  # sizes; upright and lying photographs stay apart
_WASTE = 0.25  # of all pixels, that a second size must save
_CELLS = 8  # along each axis of the grid on which near sizes are joined first, if there are more than cells


def common_sizes(sizes: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
    """The size to which each photograph is padded.

    Sizes are joined, those first that add the fewest pixels, until there are two at most, and joining any
    would add more than a quarter of all pixels.

    Args:
        sizes: width and height of each photograph, pixels.
    """
    found = np.array(sizes)
    if len(np.unique(found, axis=0)) > _CELLS**2:
        cells = sizes // -(-sizes.max(0) // _CELLS)
        for cell in np.unique(cells, axis=0):
            there = (cells == cell).all(1)
            found[there] = sizes[there].max(0)
    while True:
        groups, counts = np.unique(found, axis=0, return_counts=True)
        pixels = groups.prod(1) * counts
        joined = np.maximum(groups[:, None], groups[None])
        added = joined.prod(2) * (counts[:, None] + counts[None]) - pixels[:, None] - pixels[None]
        added = np.where(np.tri(len(groups), k=-1, dtype=bool), added, np.inf)
        if len(groups) == 1 or (len(groups) <= _MOST and added.min() > _WASTE * sizes.prod(1).sum()):
            return found
        one, other = np.unravel_index(added.argmin(), added.shape)
        belongs = (found == groups[one]).all(1) | (found == groups[other]).all(1)
        found[belongs] = joined[one, other]


def with_common_sizes(frames: list[Frame]) -> tuple[list[Frame], Float[np.ndarray, "n 2"] | None]:
    """Photographs padded to common sizes, and the shares of each one's width and height that are not padding;
    None if none is padded. If one is padded, all have masks, so that one program serves them all.

    Args:
        frames: of one camera each, on the host.
    """
    sizes = _own_sizes(frames)
    common = common_sizes(sizes)
    if (common == sizes).all():
        return frames, None
    shown = [padded(frame, size) for frame, size in zip(frames, common, strict=True)]
    return shown, sizes / common


def sizes_of(frames: list[Frame]) -> list[tuple[int, int]]:
    """The common sizes, width and height, of photographs."""
    common = np.unique(common_sizes(_own_sizes(frames)), axis=0)
    return [(int(width), int(height)) for width, height in common]


def _own_sizes(frames: list[Frame]) -> Int[np.ndarray, "n 2"]:
    return np.array([(frame.cameras.width, frame.cameras.height) for frame in frames])


def padded(frame: Frame, size: Int[np.ndarray, "2"]) -> Frame:
    """A photograph padded on the right and below, with a mask of what counts.

    Args:
        frame: of one camera, on the host.
        size: width and height, pixels, no less than its own.
    """
    width, height = (int(side) for side in size)
    camera = frame.cameras
    right, below = width - camera.width, height - camera.height
    sides = ((0, 0), (0, below), (0, right))
    mask = np.ones(frame.images.shape[:3], bool) if frame.masks is None else frame.masks
    return Frame(
        np.pad(frame.images, (*sides, (0, 0)), mode="edge"),  # so that it can be downscaled
        None if frame.depths is None else np.pad(frame.depths, sides),
        replace(camera, width=width, height=height),
        np.pad(mask, sides),
        frame.time,
    )
