"""Padding of photographs of many sizes to a few, because each size costs three compiled programs. On the
host."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from gsjax.scene.frame import Frame

_MAX_SIZES = 2  # sizes, enough to keep portrait and landscape photographs apart
_MIN_SAVING = 0.25  # share of all pixels that a second size must save
_CELLS = 8  # per axis of the grid on which similar sizes are merged first, if there are more sizes than cells


def common_sizes(sizes: Int[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
    """The size to which each photograph is padded.

    Pairs of sizes are merged, those that add the fewest pixels first, until at most two sizes are left and
    merging them would add more than a quarter of all pixels.

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
        if len(groups) == 1 or (
            len(groups) <= _MAX_SIZES and added.min() > _MIN_SAVING * sizes.prod(1).sum()
        ):
            return found
        one, other = np.unravel_index(added.argmin(), added.shape)
        belongs = (found == groups[one]).all(1) | (found == groups[other]).all(1)
        found[belongs] = joined[one, other]


def with_common_sizes(frames: list[Frame]) -> tuple[list[Frame], Float[np.ndarray, "n 2"] | None]:
    """Photographs padded to common sizes, and the share of each one's width and height that is not padding,
    or None if none is padded. If one is padded, all have masks, so that one program serves them all.

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
    """The common sizes (width, height) of photographs."""
    common = np.unique(common_sizes(_own_sizes(frames)), axis=0)
    return [(int(width), int(height)) for width, height in common]


def _own_sizes(frames: list[Frame]) -> Int[np.ndarray, "n 2"]:
    return np.array([(frame.cameras.width, frame.cameras.height) for frame in frames])


def padded(frame: Frame, size: Int[np.ndarray, "2"]) -> Frame:
    """A photograph padded on the right and at the bottom, with the padding masked out.

    Args:
        frame: of one camera, on the host.
        size: width and height, pixels, at least its own.
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
