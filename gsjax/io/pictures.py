"""Writing pictures to files."""

from pathlib import Path

import cv2
import numpy as np

from gsjax.io.atomic import atomic_write


def write_png(path: Path, picture: np.ndarray) -> None:
    """Write an RGB picture [H,W,3] or a grey one [H,W], uint8, as PNG.

    Raises:
        OSError: the file could not be written.
    """
    with atomic_write(path) as temporary:
        rows = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        if not cv2.imwrite(str(temporary), rows):
            raise OSError(f"{path}: the picture could not be written; check disk space and permissions")
