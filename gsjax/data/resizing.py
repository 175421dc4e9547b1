"""Smaller pictures: colours are means over what a pixel covers, depths and labels those in its middle."""

from collections.abc import Callable

import cv2
import numpy as np


def expect_scale(scale: float) -> None:
    """Raises ValueError unless a scale is above 0 and at most 1."""
    if not 0 < scale <= 1:
        raise ValueError(f"scale must be above 0 and at most 1, got {scale}")


def blended(load: Callable, size: Callable[..., tuple[int, int]]) -> Callable:
    """A loader of colours, in pictures of `size(...)` (width, height), where it has any."""
    return _resized(load, size, cv2.INTER_AREA)


def picked(load: Callable | None, size: Callable[..., tuple[int, int]]) -> Callable | None:
    """A loader of what has no mean: depths, labels, masks."""
    return load and _resized(load, size, cv2.INTER_NEAREST_EXACT)


def _resized(load: Callable, size: Callable[..., tuple[int, int]], how: int) -> Callable:
    def smaller(*which: int) -> np.ndarray | None:
        full = load(*which)
        if full is None:
            return None
        picture = full.astype(np.uint8) if full.dtype == bool else full
        return cv2.resize(picture, size(*which), interpolation=how).astype(full.dtype)

    return smaller
