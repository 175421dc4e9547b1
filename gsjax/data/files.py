"""Reading single files with checks: text, JSON, arrays, images and depth."""

import io
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gsjax.data.errors import COMPLETE, DataError, MissingFile
from gsjax.data.pictures import is_raw, is_truncated, unread_format
from gsjax.data.text import decoded
from gsjax.io.arrays import ArraysError, load_arrays
from gsjax.io.pictures import PictureError, pillow_errors

SATURATED_DEPTH = 65535
"""The largest 16-bit value: converters clip to it, and the Kinect writes it where it measured nothing."""

Color = tuple[float, float, float]
"""RGB, 0 to 1."""

_HEAD = 32  # bytes that identify a format
_NUM_CHECKED = 4
BLACK: Color = (0.0, 0.0, 0.0)
WHITE: Color = (1.0, 1.0, 1.0)
_LONE_BACKSLASH = re.compile(r'(?<!\\)\\(?![\\"])')


def read_text(path: Path, expected: str = "text") -> str:
    """The text of a file, with lines that end in a newline.

    Args:
        path: the file, in UTF-8, UTF-16 or UTF-32, or else in a Western code page.
        expected: what the file should be, for messages.

    Raises:
        DataError: the file is missing or not text.
    """
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise DataError(path, expected, "no such file", COMPLETE) from None
    try:
        return decoded(content)
    except ValueError as error:
        raise DataError(path, expected, f"binary data ({error})", "Fetch the file again.") from None


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        DataError: the file is missing or is not JSON.
    """
    text = read_text(path, "a JSON file")
    try:
        return _parsed(text)
    except (ValueError, RecursionError) as error:  # a number with too many digits is not a JSONDecodeError
        raise DataError(path, "a JSON file", f"bad JSON ({error})", "Fetch the file again.") from None


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        if not error.msg.startswith("Invalid \\"):
            raise
    return json.loads(_LONE_BACKSLASH.sub(r"\\\\", text))  # Windows paths written without escaping


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; the array of an .npy file has the name "". Nothing is unpickled.

    Raises:
        DataError: the file is missing, truncated, or does not hold plain arrays.
    """
    try:
        return load_arrays(path)
    except FileNotFoundError:
        raise DataError(path, "arrays", "no such file", COMPLETE) from None
    except ArraysError as error:
        raise DataError(path, "plain arrays", f"bad data ({error})", "Fetch the file again.") from None


def as_numbers(path: Path, what: str, value: Any, shape: tuple[int | None, ...]) -> Float[np.ndarray, "..."]:
    """Numbers read from a file, as float64, after a check of their shape.

    Args:
        path: the file, for messages.
        what: what they are, for messages.
        value: what the file holds.
        shape: the expected shape; None for a dimension of any size.

    Raises:
        DataError: they are not numbers, or have another shape.
    """
    try:
        found = np.asarray(value)
        given = found.astype(np.float64) if found.dtype.kind in "iuf" else None
    except (ValueError, TypeError, OverflowError):  # rows of different lengths
        given = None
    if (
        given is None
        or len(shape) != given.ndim
        or any(size not in (None, count) for size, count in zip(shape, given.shape, strict=True))
    ):
        sizes = "x".join("N" if size is None else str(size) for size in shape)
        has = repr(value) if given is None else f"{'x'.join(map(str, given.shape)) or 1} numbers"
        raise DataError(path, f"{what} as {sizes or 1} numbers", has, "Fetch the file again.")
    return given


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image in pixels.

    Raises:
        DataError: the file is missing, truncated, or not an image.
    """
    height, width = decode(path, "an image").shape[:2]
    return width, height


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a photograph in pixels, as stored, read from the file header only.

    Raises:
        DataError: the file is missing or not an image.
    """
    from PIL import Image

    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            if is_raw(path, head):
                raise _not_read(path, "an image", head)
            with pillow_errors(), Image.open(file) as image:
                return image.size
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        raise _no_such_file(path, "an image") from None
    except PictureError as error:
        raise _not_read(path, "an image", head, f"{path.stat().st_size} bytes; {error}") from None


def find_background(paths: list[Path], background: Color = WHITE) -> Color | None:
    """The background to composite photographs on: `background` if some are transparent, else None.

    Only a few of the photographs are decoded, and only those with transparency according to their header.

    Args:
        paths: the photographs.
        background: RGB, 0 to 1.

    Raises:
        DataError: one of those decoded is unreadable.
    """
    able = [path for path in paths if _has_transparency(path)]
    some = able[:: max(1, len(able) // _NUM_CHECKED)]
    return background if any(_is_transparent(_read_channels(path)) for path in some) else None


def read_image(
    path: Path, width: int, height: int, background: Color = BLACK
) -> UInt8[np.ndarray, "height width 3"]:
    """An 8-bit colour image, RGB, in its stored orientation: cameras are calibrated for the stored pixels,
    so the EXIF orientation is ignored. Transparent pixels are composited on the background: the colours
    stored there mean nothing.

    Args:
        path: the file.
        width, height: expected size, pixels.
        background: RGB, 0 to 1, behind transparent pixels.

    Raises:
        DataError: the file is missing, truncated, not an image, or of another size.
    """
    pixels = read_rgba(path, width, height)
    if not _is_transparent(pixels):
        return np.ascontiguousarray(pixels[..., :3])
    alpha = pixels[..., 3:] / 255
    return np.round(alpha * pixels[..., :3] + (1 - alpha) * 255 * np.array(background)).astype(np.uint8)


def read_rgba(path: Path, width: int, height: int) -> UInt8[np.ndarray, "height width channels"]:
    """An image with 3 channels, RGB, or 4 if it has transparency; 16 bits are converted to 8.

    Args:
        path: the file.
        width, height: expected size, pixels.

    Raises:
        DataError: the file is missing, truncated, not an image, or of another size.
    """
    image = _read_channels(path)
    check_size(path, image, width, height)
    return image


def _read_channels(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    image = decode(path, "an image")
    if image.dtype == np.uint16:
        image = np.round(image / 257).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DataError(path, "an image of 8 or 16 bits", f"{image.dtype}", "Save it as PNG or JPEG.")
    if image.ndim == 2:
        return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)
    if image.shape[2] == 3:
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def _is_transparent(pixels: UInt8[np.ndarray, "height width channels"]) -> bool:
    return pixels.shape[-1] == 4 and bool((pixels[..., 3] < 255).any())


def _has_transparency(path: Path) -> bool:
    """Whether a photograph has an alpha channel or a transparent colour, according to its header."""
    from PIL import Image

    try:
        with pillow_errors(), Image.open(path) as image:
            return image.has_transparency_data
    except PictureError:
        return False  # reported when it is read


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
    raw = decode(path, "a depth image")
    check_size(path, raw, width, height)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        found = f"{raw.dtype} with {1 if raw.ndim == 2 else raw.shape[2]} channels"
        raise DataError(path, "depth as one 16-bit channel", found, "Save depth as a 16-bit PNG.")
    depth = (raw * unit_m).astype(np.float32)
    return np.where(raw == SATURATED_DEPTH, np.float32(0), depth)


def decode(path: Path, kind: str) -> np.ndarray:
    """The pixels of a picture as they are stored, of any type: [H,W], or [H,W,3] or [H,W,4] in the order
    blue, green, red, alpha. Palette indices are replaced by their colours.

    Args:
        path: the file.
        kind: what it is, for messages.

    Raises:
        DataError: the file is missing, truncated, not a picture in a format that is read, or claims far more
            pixels than any camera has.
    """
    content = read_complete(path, kind)
    if _is_bomb(content):
        found = f"{len(content)} bytes that say they are far more pixels than any camera takes"
        raise DataError(path, kind, found, "Fetch the file again, or save it smaller.")
    # Pictures are decoded in several threads, which share the warning filters, so none may change them.
    image = None if _has_transparent_grey(content) else _decoded_by_opencv(content)
    image = _decoded_by_pillow(content) if image is None else image
    if image is None:
        raise _not_read(path, kind, content[:_HEAD], f"{len(content)} bytes")
    return image


def _is_bomb(content: bytes) -> bool:
    """Whether a picture has more pixels than Pillow accepts, by its header; OpenCV would decode it."""
    from PIL import Image

    try:
        with pillow_errors():
            Image.open(io.BytesIO(content)).close()
    except PictureError as error:
        return isinstance(error.__cause__, Image.DecompressionBombError)
    return False


def _has_transparent_grey(content: bytes) -> bool:
    """Whether a PNG picture of at most 8 bits has a transparent shade of grey, which OpenCV ignores."""
    is_grey = content.startswith(b"\x89PNG") and content[24:25] <= b"\x08" and content[25:26] == b"\0"
    return is_grey and b"tRNS" in content[:4096]


def _decoded_by_opencv(content: bytes) -> np.ndarray | None:
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _decoded_by_pillow(content: bytes) -> np.ndarray | None:
    """Pixels of formats that OpenCV lacks, for example those of plug-ins; None if Pillow lacks them too."""
    from PIL import Image

    try:
        with pillow_errors(), Image.open(io.BytesIO(content)) as image:
            channels = "RGBA" if image.has_transparency_data else "RGB"
            pixels = np.asarray(image.convert(channels))
    except PictureError:
        return None
    return cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA if channels == "RGBA" else cv2.COLOR_RGB2BGR)


def read_complete(path: Path, kind: str) -> bytes:
    """The bytes of a picture.

    Args:
        path: the file.
        kind: what it is, for messages.

    Raises:
        DataError: the file is missing, empty, truncated, or a camera's raw data.
    """
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        raise _no_such_file(path, kind) from None
    if is_raw(path, content[:_HEAD]):
        raise _not_read(path, kind, content[:_HEAD])
    if not content or is_truncated(content):
        what = "a file that is cut off" if content else "something else"
        raise DataError(path, kind, f"{what} ({len(content)} bytes)", "Fetch the file again.")
    return content


def _not_read(path: Path, kind: str, head: bytes, why: str = "") -> DataError:
    """The error for a file that no decoder can read."""
    if (unread := unread_format(path, head)) is not None:
        return DataError(path, kind, f"{unread[0]}, a format that is not read", unread[1])
    return DataError(path, kind, f"something else ({why})", "Fetch the file again.")


def _no_such_file(path: Path, kind: str) -> MissingFile:
    advice = "Restore it, or remove that frame (of all cameras, and from any metadata)."
    return MissingFile(path, kind, "no such file", advice)


def check_size(path: Path, image: np.ndarray, width: int, height: int) -> None:
    """Raises DataError unless a picture has the expected size.

    Args:
        path: the file, for messages.
        image: its pixels, [H,W] or [H,W,C].
        width, height: expected size, pixels.
    """
    if image.shape[:2] != (height, width):
        found = f"{image.shape[1]}x{image.shape[0]}"
        raise DataError(
            path, f"{width}x{height} pixels", found, "All images, depths and masks must have one size."
        )
