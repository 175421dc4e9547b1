"""Still pictures of a video: of each stretch the sharpest."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from gsjax.data.errors import DataError
from gsjax.data.video import describe_video

_JUDGED_WIDTH = 480  # pixels: enough to tell a shake from a steady hand
_JPEG_QUALITY = 95


def write_stills(video: Path, folder: Path, count: int) -> list[str]:
    """Write the sharpest frame of each of `count` equal stretches of a video as frame_NUMBER.jpg, upright as
    players show it; all frames where it has fewer.

    Args:
        video: the file.
        folder: where pictures go; it is made.
        count: how many, at most.

    Returns:
        Their names, in order of time.

    Raises:
        DataError: the file is missing, or no video.
        ValueError: `count` is less than 1.
    """
    if count < 1:
        raise ValueError(f"frames: expected 1 or more, found {count}")
    total = describe_video(video).frames
    stretches = (
        np.minimum(np.arange(total) * count // total, count - 1) if total > count else np.arange(total)
    )
    folder.mkdir(parents=True, exist_ok=True)
    capture, names = cv2.VideoCapture(str(video)), []
    best: tuple[float, int, np.ndarray] | None = None
    number = 0
    while (grabbed := capture.read())[0]:
        stretch = stretches[min(number, total - 1)]
        if best is not None and stretches[min(best[1], total - 1)] != stretch:
            names.append(_write(folder, *best[1:]))
            best = None
        sharp = sharpness(grabbed[1])
        if best is None or sharp > best[0]:
            best = (sharp, number, grabbed[1])
        number += 1
    capture.release()
    if best is None:
        raise DataError(video, "a video", "one of which no frame can be read", "Fetch the file again.")
    return [*names, _write(folder, *best[1:])]


def sharpness(picture: UInt8[np.ndarray, "height width 3"]) -> float:
    """Variance of the Laplacian of a small grey copy: comparable among frames of one video."""
    scale = min(1.0, _JUDGED_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), cv2.CV_64F).var())


def _write(folder: Path, number: int, picture: np.ndarray) -> str:
    path = folder / f"frame_{number:06d}.jpg"
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
        raise OSError(f"{path}: could not be written; is the disk full?")
    return path.name
