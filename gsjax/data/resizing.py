"""Downscaling: colours are averaged over the area of each new pixel; depths and labels take its centre."""

from collections.abc import Callable

import cv2
import numpy as np


def check_scale(scale: float) -> None:
    """Raises ValueError unless a scale is above 0 and at most 1."""
    if not 0 < scale <= 1:
        raise ValueError(f"scale must be above 0 and at most 1, got {scale}")


def area_resized(load: Callable, size: Callable[..., tuple[int, int]]) -> Callable:
    """A loader that resizes colour images to `size(...)`, (width, height), by area averaging."""
    return _resized(load, size, cv2.INTER_AREA)


def nearest_resized(load: Callable | None, size: Callable[..., tuple[int, int]]) -> Callable | None:
    """A loader that resizes depths, labels or masks, which must not be averaged, to `size(...)`."""
    return load and _resized(load, size, cv2.INTER_NEAREST_EXACT)


def _resized(load: Callable, size: Callable[..., tuple[int, int]], interpolation: int) -> Callable:
    def resized(*indices: int) -> np.ndarray | None:
        full = load(*indices)
        if full is None:
            return None
        picture = full.astype(np.uint8) if full.dtype == bool else full
        return cv2.resize(picture, size(*indices), interpolation=interpolation).astype(full.dtype)

    return resized
