"""The frames of a video by number, each with its own time.

Cameras of phones and screen recorders write frames at a varying rate, and headers are often wrong about
their number. So times are those of the file's packets (presentation timestamps), which ffmpeg lists without
decoding anything; if that list is doubtful, the video is decoded once to see what it holds.
"""

import threading
import warnings
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.io.video import Packets, list_packets

# Decoding a few more frames is faster than seeking, which restarts at the previous key frame.
_SKIP_AT_MOST = 12
_BACK_S = (0.0, 1.0, 5.0, 20.0)  # OpenCV seeks by a mean rate, so it may land too late
_DEFAULT_RATE_HZ = 30.0
_COUNTED = (".mp4", ".mov", ".m4v")  # containers that state a number of frames, not only a duration
_HIDDEN = ("vp8",)  # codecs with packets that show no picture of their own


class VideoFile(NamedTuple):
    """Contents of a video file.

    Attributes:
        width: pixels, as players show it: with the file's rotation applied.
        height: pixels.
        times: time of each frame that can be decoded, seconds after the first, [T].
        stamped: whether the file stores these times; otherwise they follow from its frame rate.
    """

    width: int
    height: int
    times: Float[np.ndarray, "T"]
    stamped: bool = True

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.times)


def describe_video(path: Path) -> VideoFile:
    """The size and the times of the frames of a video.

    Warns with DataWarning if frames cannot be decoded, and counts them.

    Raises:
        DataError: the file is missing or not a video.
    """
    capture = _opened(path)
    try:
        packets, stated = list_packets(path), int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        stated = stated - packets.skipped if path.suffix.lower() in _COUNTED else 0
        times, stamped = packets.times, True
        if _is_doubtful(packets) or stated not in (0, len(times)):
            times, stamped = _decoded_times(capture)
        width, height = (int(capture.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    finally:
        capture.release()
    if not len(times) or min(width, height) <= 0:
        raise _not_a_video(path)
    total = max(stated, 0 if packets.codec in _HIDDEN else len(packets.times))
    if total > len(times):
        lost = f"{total - len(times)} of the {total} frames that the file states"
        message = f"{path}: {lost} cannot be decoded and are left out; was it copied completely?"
        warnings.warn(message, DataWarning, stacklevel=2)
    return VideoFile(width, height, times - times[0], stamped)


def _is_doubtful(packets: Packets) -> bool:
    """Whether the packets may not be the frames that a decoder returns."""
    return not packets.sound or packets.codec in _HIDDEN or not (np.diff(packets.times) > 0).all()


def _decoded_times(capture: cv2.VideoCapture) -> tuple[Float[np.ndarray, "T"], bool]:
    """The time of each frame that can be decoded, seconds, and whether the file states them."""
    stamps = []
    while capture.grab():
        stamps.append(1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC))
    times = np.array(stamps)
    if (np.diff(times) > 0).all():
        return times, True
    rate_hz = capture.get(cv2.CAP_PROP_FPS)
    return np.arange(len(times)) / (rate_hz if 0 < rate_hz < np.inf else _DEFAULT_RATE_HZ), False


class Video:
    """A video file whose frames are read by number, fastest in order. It is opened at the first read."""

    def __init__(self, path: Path, width: int, height: int, num_frames: int, file: VideoFile | None = None):
        """Create a reader that expects `num_frames` frames of width x height pixels.

        Args:
            path: the file.
            width, height: pixels.
            num_frames: number of frames.
            file: the result of `describe_video`; None: called at the first read.

        Raises:
            DataError: the file is missing.
        """
        if not path.exists():
            raise _no_such_video(path)
        self.path, self.width, self.height, self.num_frames = path, int(width), int(height), num_frames
        self._file = file
        self._capture: cv2.VideoCapture | None = None
        self._first, self._grabbed = 0.0, 0
        self._lock = threading.Lock()

    def frame(self, index: int) -> UInt8[np.ndarray, "height width 3"]:
        """RGB.

        Raises:
            DataError: the file is not a video, has another size or number of frames, or is truncated.
        """
        with self._lock:
            file = self._described()
            found = index < file.frames and self._go_to(file, index)
            success, image = self._capture.retrieve() if found and self._capture else (False, None)
        if not success or image is None:
            expected, found = f"{self.num_frames} frames", f"no frame {index}"
            raise DataError(self.path, expected, found, "Fetch the file again; is it cut off?")
        if image.shape != (self.height, self.width, 3):
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise DataError(self.path, f"{self.width}x{self.height} pixels", found, "Correct the resolution.")
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)

    def _described(self) -> VideoFile:
        if self._file is None:
            self._file = describe_video(self.path)
        if self._file.frames != self.num_frames:
            expected = f"{self.num_frames} frames, one per timestamp"
            advice = "Fetch the video and its JSON file again."
            raise DataError(self.path, expected, f"{self._file.frames}", advice)
        return self._file

    def _go_to(self, file: VideoFile, index: int) -> bool:
        """Grab frame `index`. False if it cannot be decoded."""
        times = file.times
        wanted, near = times[index], 0.5 * np.diff(times).min(initial=1.0)
        if self._capture is None:
            self._restart()
        at = self._time(file)
        if at > wanted + near or np.searchsorted(times, at + near) + _SKIP_AT_MOST < index:
            self._seek(file, wanted, near)
        while self._time(file) < wanted - near:
            if not self._grab():
                self._capture = None
                return False
        return bool(abs(self._time(file) - wanted) <= near)

    def _seek(self, file: VideoFile, wanted: float, near: float) -> None:
        """Grab a frame at or before a time."""
        for back in _BACK_S if file.stamped else ():
            if self._capture is not None and back < wanted:
                self._capture.set(cv2.CAP_PROP_POS_MSEC, 1e3 * (self._first + wanted - back))
                if self._grab() and self._time(file) <= wanted + near:
                    return
        self._restart()

    def _restart(self) -> None:
        self._capture, self._grabbed = _opened(self.path), 0
        self._grab()
        self._first = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)

    def _grab(self) -> bool:
        self._grabbed += 1
        return self._capture is not None and self._capture.grab()

    def _time(self, file: VideoFile) -> float:
        """The time of the grabbed frame; infinity if none is grabbed."""
        if self._capture is None:
            return np.inf
        if not file.stamped:
            return float(file.times[self._grabbed - 1]) if self._grabbed <= file.frames else np.inf
        return 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC) - self._first


def _opened(path: Path) -> cv2.VideoCapture:
    if not path.exists():
        raise _no_such_video(path)
    capture = cv2.VideoCapture(str(path.absolute()))
    if not capture.isOpened():
        raise _not_a_video(path)
    return capture


def _no_such_video(path: Path) -> DataError:
    return DataError(path, "a video", "no such file", COMPLETE)


def _not_a_video(path: Path) -> DataError:
    return DataError(path, "a video", "a file that does not open", "Fetch the file again.")
