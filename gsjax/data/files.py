"""Reading single files with checks: JSON, arrays, images, depth and masks."""

import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from gsjax.data.errors import DataError, MissingFile

SATURATED_DEPTH = 65535
"""The largest 16-bit value: converters clip to it, and the Kinect writes it where it measured nothing."""

# OpenCV decodes the missing rest of a truncated file as grey, so end markers are checked here.
_END_MARKS = {b"\x89PNG": b"IEND", b"\xff\xd8": b"\xff\xd9"}
_TAIL = 64


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        DataError: the file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(
            path, "a JSON file", "no such file", "Check the folder; was it copied completely?"
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(path, "a JSON file", f"bad JSON ({error})", "Fetch the file again.") from None


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; the array of an .npy file has the name "". Nothing is unpickled.

    Raises:
        DataError: the file is missing, truncated, or does not hold plain arrays.
    """
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return {"": loaded}
        with loaded:
            return dict(loaded)
    except FileNotFoundError:
        advice = "Check the folder; was it copied completely?"
        raise DataError(path, "arrays", "no such file", advice) from None
    except (ValueError, EOFError, MemoryError, OverflowError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(path, "plain arrays", f"bad data ({error})", "Fetch the file again.") from None


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image in pixels.

    Raises:
        DataError: the file is missing, truncated, or not an image.
    """
    height, width = _decode(path, cv2.IMREAD_UNCHANGED).shape[:2]
    return width, height


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a photograph in pixels, as stored, read from the file header only.

    Raises:
        DataError: the file is missing or not an image.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except FileNotFoundError:
        raise _no_such_file(path, "an image") from None
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        found = f"something else ({path.stat().st_size} bytes; {error})"
        raise DataError(path, "an image", found, "Fetch the file again.") from None


def read_image(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
    """An 8-bit colour image, RGB, in its stored orientation: cameras are calibrated for the stored pixels,
    so the EXIF orientation is ignored.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, not an image, or of another size.
    """
    image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    _check_size(path, image, width, height)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def read_rgba(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width channels"]:
    """An image with 3 channels, RGB, or 4 if it has transparency; 16 bits are converted to 8.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, not an image, or of another size.
    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    _check_size(path, image, width, height)
    if image.dtype == np.uint16:
        image = np.round(image / 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DataError(path, "an image of 8 or 16 bits", f"{image.dtype}", "Save it as PNG or JPEG.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    if image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def read_depth(path: Path, unit_m: float, width: int, height: int) -> Float[np.ndarray, "height width"]:
    """Depth in metres (float32, 0 = invalid) from a 16-bit image.

    0 and 65535 are invalid.

    Args:
        path: the file.
        unit_m: metres per step.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, not a 16-bit single-channel image, or of another size.
    """
    raw = _decode(path, cv2.IMREAD_UNCHANGED, "a depth image")
    _check_size(path, raw, width, height)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        found = f"{raw.dtype} with {1 if raw.ndim == 2 else raw.shape[2]} channels"
        raise DataError(path, "depth as one 16-bit channel", found, "Save depth as a 16-bit PNG.")
    depth = (raw * unit_m).astype(np.float32)
    return np.where(raw == SATURATED_DEPTH, np.float32(0), depth)


def read_mask(path: Path, width: int, height: int) -> Int[np.ndarray, "height width"]:
    """Integer labels, int32. A mask saved with three equal channels is accepted.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, has channels that differ, or is of another size.
    """
    raw = _decode(path, cv2.IMREAD_UNCHANGED, "a mask")
    _check_size(path, raw, width, height)
    if raw.ndim == 3:
        colors = raw[..., :3]
        if (colors != colors[..., :1]).any():
            advice = "Save one label per pixel, as a single-channel PNG."
            raise DataError(path, "one label per pixel", f"{raw.shape[2]} channels that differ", advice)
        raw = colors[..., 0]
    return raw.astype(np.int32)


def _decode(path: Path, flags: int, kind: str = "an image") -> np.ndarray:
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise _no_such_file(path, kind) from None
    cut_off = any(
        content.startswith(head) and end not in content[-_TAIL:] for head, end in _END_MARKS.items()
    )
    image = None if cut_off or not content else cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        what = "a file that is cut off" if cut_off else "something else"
        raise DataError(path, kind, f"{what} ({len(content)} bytes)", "Fetch the file again.")
    return image


def _no_such_file(path: Path, kind: str) -> MissingFile:
    advice = "Restore it, or remove that frame (of all cameras, and from any metadata)."
    return MissingFile(path, kind, "no such file", advice)


def _check_size(path: Path, image: np.ndarray, width: int, height: int) -> None:
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(
            path, f"{width}x{height} pixels", found, "All images, depths and masks must have one size."
        )
