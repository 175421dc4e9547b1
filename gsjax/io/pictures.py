"""Writes pictures to files, and turns Pillow's errors for damaged ones into a single type."""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from gsjax.io.atomic import atomic_write
from gsjax.io.brief import brief

# Pillow's plug-ins check little of what a file says before they use it.
_DAMAGED = (
    *(OSError, ValueError, TypeError, LookupError, ArithmeticError, AttributeError, AssertionError),
    *(SyntaxError, EOFError, MemoryError, RuntimeError, struct.error, zlib.error),
)


class PictureError(ValueError):
    """Pillow cannot read a picture; the message briefly says why, and does not name the file."""


@contextmanager
def pillow_errors() -> Iterator[None]:
    """Re-raise whatever Pillow raises in the block for a damaged picture as a PictureError."""
    from PIL import Image

    try:
        yield
    except (*_DAMAGED, Image.DecompressionBombError) as error:
        raise PictureError(brief(error) or type(error).__name__) from error


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write an RGB picture [H,W,3] or a grey one [H,W], uint8 or uint16, as PNG.

    Raises:
        OSError: the file could not be written.
    """
    with atomic_write(path) as temporary:
        rows = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        if not cv2.imwrite(str(temporary), rows):
            raise OSError(f"{path}: the picture could not be written; check disk space and permissions")
