"""Masks in pictures: labels of pixels, and which pixels count."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, UInt8

from gsjax.data.errors import DataError
from gsjax.data.files import check_size, decode, read_complete

_KIND, _EXPECTED = "a mask", "one label per pixel"
_HALF = 128  # of alpha
_ADVICE = "Save one label per pixel, as a single-channel PNG."


def read_mask(path: Path, width: int, height: int) -> Int[np.ndarray, "height width"]:
    """Integer labels, int32: the values of a picture of one channel or of three equal ones, 0 where it is
    transparent, or the indices of a palette of colours.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, has channels that differ, or is of another size.
    """
    labels = _labels(path, width, height)
    if labels.ndim == 3:
        raise DataError(path, _EXPECTED, f"{labels.shape[2]} channels that differ", _ADVICE)
    return labels.astype(np.int32)


def read_valid_pixels(path: Path, width: int, height: int) -> Bool[np.ndarray, "height width"]:
    """Which pixels count: those whose label is not 0. A picture of black and one colour serves as well.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: as for `read_mask`, or there is more than one colour besides black.
    """
    labels = _labels(path, width, height)
    if labels.ndim == 2:
        return labels != 0
    colored = labels.any(-1)
    if len(np.unique(labels[colored], axis=0)) > 1:
        raise DataError(path, _EXPECTED, f"{labels.shape[2]} channels that differ", _ADVICE)
    return colored


def _labels(path: Path, width: int, height: int) -> np.ndarray:
    """Labels [H,W]; or colours [H,W,3] if channels differ."""
    indices = _palette_labels(path)
    raw = decode(path, _KIND) if indices is None else indices
    check_size(path, raw, width, height)
    if raw.dtype.kind not in "ui":
        raise DataError(path, _EXPECTED, f"{raw.dtype}", _ADVICE)
    if raw.ndim == 2:
        return raw
    colors = raw[..., :3]
    if raw.shape[2] == 4:
        colors = _opaque(path, colors, raw[..., 3])
    return colors[..., 0] if (colors == colors[..., :1]).all() else colors


def _opaque(path: Path, colors: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """The colours where they are opaque; what is transparent is black."""
    full = np.iinfo(alpha.dtype).max
    opaque = alpha >= _HALF * (full // 255)
    if not opaque.all() and opaque.any() and not colors[opaque].any():
        found = "black everywhere that is not transparent"
        raise DataError(path, _EXPECTED, found, "Save it in black and white, without transparency.")
    return np.where(opaque[..., None], colors, 0)


def _palette_labels(path: Path) -> np.ndarray | None:
    """The indices of a picture with a palette; None if it has none, or one of shades of grey that are not in
    their order, as programs make of grey pictures to save space."""
    from PIL import Image, UnidentifiedImageError

    content = read_complete(path, _KIND)
    try:
        with Image.open(io.BytesIO(content)) as image:
            if image.mode != "P":
                return None
            palette = np.reshape(image.getpalette("RGB"), (-1, 3))
            return None if _is_shuffled_grey(palette) else np.asarray(image)
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError):
        return None  # whoever decodes it tells


def _is_shuffled_grey(palette: UInt8[np.ndarray, "n 3"]) -> bool:
    shades = list(dict.fromkeys(palette[:, 0].tolist()))
    return bool((palette == palette[:, :1]).all()) and shades != sorted(shades)
