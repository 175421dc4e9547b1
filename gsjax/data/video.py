"""Random access to the frames of a video."""

import threading
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from gsjax.data.errors import DataError

# Decoding a few more frames is faster than seeking, which restarts at the previous key frame.
_SKIP_AT_MOST = 12


class VideoFile(NamedTuple):
    """Metadata of a video file."""

    width: int
    height: int
    frames: int
    rate_hz: float


def describe_video(path: Path) -> VideoFile:
    """The size, number of frames and rate of a video.

    Raises:
        DataError: the file is missing or not a video.
    """
    if not path.exists():
        raise DataError(path, "a video", "no such file", "Check the folder; was it copied completely?")
    capture = cv2.VideoCapture(str(path))
    properties = (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_COUNT)
    width, height, frames = (int(capture.get(number)) for number in properties)
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    capture.release()
    if min(width, height, frames, rate_hz) <= 0:
        raise DataError(path, "a video", "a file that does not open", "Fetch the file again.")
    return VideoFile(width, height, frames, rate_hz)


class Video:
    """A video file whose frames are read by number, fastest in order. It is opened at the first read."""

    def __init__(self, path: Path, width: int, height: int, num_frames: int):
        """Create a reader that expects `num_frames` frames of width x height pixels.

        Raises:
            DataError: the file is missing.
        """
        if not path.exists():
            raise DataError(path, "a video", "no such file", "Check the folder; was it copied completely?")
        self.path, self.width, self.height, self.num_frames = path, int(width), int(height), num_frames
        self._capture: cv2.VideoCapture | None = None
        self._next = 0
        self._lock = threading.Lock()

    def frame(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """RGB.

        Raises:
            DataError: the file is not a video, has another size or number of frames, or is truncated.
        """
        with self._lock:
            capture = self._open()
            if not 0 <= index - self._next <= _SKIP_AT_MOST:
                capture.set(cv2.CAP_PROP_POS_FRAMES, index)
                self._next = index
            while self._next < index and capture.grab():
                self._next += 1
            success, image = capture.read()
            self._next = index + 1
        if not success:
            found = f"no frame {index}"
            raise DataError(
                self.path, f"{self.num_frames} frames", found, "Fetch the file again; is it cut off?"
            )
        if image.shape != (self.height, self.width, 3):
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise DataError(self.path, f"{self.width}x{self.height} pixels", found, "Correct the resolution.")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _open(self) -> cv2.VideoCapture:
        if self._capture is None:
            capture = cv2.VideoCapture(str(self.path))
            if not capture.isOpened():
                raise DataError(self.path, "a video", "a file that does not open", "Fetch the file again.")
            count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
            if count != self.num_frames:
                expected = f"{self.num_frames} frames, one per timestamp"
                raise DataError(self.path, expected, f"{count}", "Fetch the video and its JSON file again.")
            self._capture = capture
        return self._capture
