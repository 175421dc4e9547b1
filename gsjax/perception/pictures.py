"""Helpers for images, shared by the perception modules."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Num, UInt8


def unit_floats(image: Num[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Colours as floats 0 to 1; integers are taken as bytes, and NaN becomes black."""
    image = np.asarray(image)
    scale = 255.0 if np.issubdtype(image.dtype, np.integer) else 1.0
    return np.clip(np.nan_to_num(image / scale), 0.0, 1.0)


def to_bytes(image: Num[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Colours as bytes."""
    image = np.asarray(image)
    return image if image.dtype == np.uint8 else np.round(255 * unit_floats(image)).astype(np.uint8)


def square_crop(
    image: Num[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"], margin: float = 0.15
) -> Num[np.ndarray, "side side 3"]:
    """The smallest square crop around a mask, plus a margin; outside the image, its border is repeated.

    Args:
        image: the image to crop.
        mask: True on the object.
        margin: margin on each side, as a fraction of the square's side.

    Raises:
        ValueError: the mask is empty.
    """
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        raise ValueError("mask: expected at least one pixel that is set, found none")
    low = np.array([rows.min(), columns.min()])
    high = np.array([rows.max(), columns.max()]) + 1
    side = int(np.ceil((high - low).max() * (1 + 2 * margin)))
    start = np.floor((low + high - side) / 2).astype(int)
    take: list[Int[np.ndarray, "side"]] = [
        np.clip(np.arange(begin, begin + side), 0, size - 1)
        for begin, size in zip(start, mask.shape, strict=True)
    ]
    return image[np.ix_(*take)]


def in_patches(
    images: Num[np.ndarray, "C H W 3"], processor: Any, patch: int, resolution: int
) -> tuple[Any, int, int]:
    """Input of a vision transformer for whole images, resized to a whole number of patches without cropping.

    Args:
        images: RGB, uint8 or floats 0 to 1.
        processor: image processor of transformers, which resizes and normalises.
        patch: side of a patch, pixels.
        resolution: shorter side after resizing, pixels, rounded to whole patches.

    Returns:
        The torch tensor of pixels [C,3,rows * patch,columns * patch], and the numbers of rows and columns of
        patches per image.
    """
    scale = resolution / min(images.shape[1:3])
    rows, columns = (max(1, round(side * scale / patch)) for side in images.shape[1:3])
    size = {"height": rows * patch, "width": columns * patch}
    pictures = [to_bytes(image) for image in images]
    seen = processor(pictures, size=size, do_center_crop=False, return_tensors="pt")
    return seen["pixel_values"], rows, columns
