"""Masks stored as pictures: one label per pixel, or black and white."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8

from gsjax.data.errors import DataError
from gsjax.data.files import check_size, decode, read_complete
from gsjax.io.pictures import PictureError, pillow_errors

_KIND, _EXPECTED = "a mask", "one label per pixel"
_HALF = 128  # alpha, of 255, from which a pixel counts as opaque
_WHITE = 255
_ADVICE = "Save one label per pixel, as a single-channel PNG."


def read_mask(path: Path, width: int, height: int) -> Int[np.ndarray, "height width"]:
    """Integer labels, int32: the values of a picture with one channel or three equal ones, 0 where it is
    transparent, or the indices of a palette. If the palette consists of unsorted shades of grey, which
    programs write for grey pictures to save space, the shades are the labels.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, has channels that differ, or is of another size.
    """
    indices, palette = _indexed(path)
    labels = _shades(path, width, height) if _is_shuffled_grey(palette) else indices
    check_size(path, labels, width, height)
    if labels.ndim == 3:
        raise _differ(path, labels)
    return labels.astype(np.int32)


def read_shades(path: Path, width: int, height: int) -> Int[np.ndarray, "height width"]:
    """The shades of grey, int32, of a black-and-white mask. If it has black and one colour, or a palette of
    colours, whatever is not black is white; with a palette and no black pixel, index 0 counts as black.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: as for `read_mask`, or there is more than one colour besides black, without a palette.
    """
    shades = _shades(path, width, height)
    if shades.ndim == 3:
        white, (indices, palette) = shades.any(-1), _indexed(path)
        if len(palette):
            white = indices != 0 if white.all() else white
        elif len(np.unique(shades[white], axis=0)) > 1:
            raise _differ(path, shades)
        shades = np.where(white, _WHITE, 0)
    return shades.astype(np.int32)


def _differ(path: Path, colors: np.ndarray) -> DataError:
    return DataError(path, _EXPECTED, f"{colors.shape[2]} channels that differ", _ADVICE)


def _shades(path: Path, width: int, height: int) -> np.ndarray:
    """The values of a picture [H,W]; or its colours [H,W,3] if channels differ."""
    raw = decode(path, _KIND)
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
    """The colours, with transparent pixels turned black."""
    full = np.iinfo(alpha.dtype).max
    opaque = alpha >= _HALF * (full // 255)
    if not opaque.all() and opaque.any() and not colors[opaque].any():
        found = "black everywhere that is not transparent"
        raise DataError(path, _EXPECTED, found, "Save it in black and white, without transparency.")
    return np.where(opaque[..., None], colors, 0)


def _indexed(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The indices of a picture and its palette [n,3]; both are empty without a palette."""
    from PIL import Image

    none = np.zeros((0, 0), np.uint8), np.zeros((0, 3), np.uint8)
    content = read_complete(path, _KIND)
    try:
        with pillow_errors(), Image.open(io.BytesIO(content)) as image:
            if image.mode != "P":
                return none
            return np.asarray(image), np.array(image.getpalette("RGB"), np.uint8).reshape(-1, 3)
    except PictureError:
        return none  # reported when it is decoded


def _is_shuffled_grey(palette: UInt8[np.ndarray, "n 3"]) -> bool:
    """Whether the indices are not labels: the palette has unsorted shades of grey, or there is none."""
    shades = list(dict.fromkeys(palette[:, 0].tolist()))
    return bool((palette == palette[:, :1]).all()) and (not shades or shades != sorted(shades))
