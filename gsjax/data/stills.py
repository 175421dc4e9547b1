"""Still pictures from a video: the sharpest frame of each segment."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from gsjax.data.errors import DataError
from gsjax.data.video import describe_video

_SHARPNESS_WIDTH = 480  # pixels: enough to detect motion blur
_JPEG_QUALITY = 95


def write_stills(video: Path, folder: Path, count: int) -> list[str]:
    """Write the sharpest frame of each of `count` equal segments of a video as frame_NUMBER.jpg, rotated
    upright as players show it; or all frames if there are fewer than `count`.

    Args:
        video: the file.
        folder: output folder; created if missing.
        count: largest number of pictures.

    Returns:
        The names of the pictures, in order of time.

    Raises:
        DataError: the file is missing or not a video.
        ValueError: `count` is less than 1.
    """
    if count < 1:
        raise ValueError(f"frames: expected 1 or more, found {count}")
    total = describe_video(video).frames
    segments = np.minimum(np.arange(total) * count // total, count - 1) if total > count else np.arange(total)
    folder.mkdir(parents=True, exist_ok=True)
    capture, names = cv2.VideoCapture(str(video)), []
    best: tuple[float, int, np.ndarray] | None = None
    number = 0
    while (grabbed := capture.read())[0]:
        segment = segments[min(number, total - 1)]
        if best is not None and segments[min(best[1], total - 1)] != segment:
            names.append(_write(folder, *best[1:]))
            best = None
        sharp = sharpness(grabbed[1])
        if best is None or sharp > best[0]:
            best = (sharp, number, grabbed[1])
        number += 1
    capture.release()
    if best is None:
        raise DataError(video, "a video", "one without a readable frame", "Fetch the file again.")
    return [*names, _write(folder, *best[1:])]


def sharpness(picture: UInt8[np.ndarray, "height width 3"]) -> float:
    """Variance of the Laplacian of a downscaled grey copy; comparable between frames of one video."""
    scale = min(1.0, _SHARPNESS_WIDTH / picture.shape[1])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), cv2.CV_64F).var())


def _write(folder: Path, number: int, picture: np.ndarray) -> str:
    path = folder / f"frame_{number:06d}.jpg"
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]):
        raise OSError(f"{path}: could not be written; is the disk full?")
    return path.name
