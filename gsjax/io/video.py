"""Videos that browsers can play: H.264, yuv420p, encoded by the ffmpeg bundled with imageio-ffmpeg, which
also lists the packets of any video."""

import contextlib
import os
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Num, UInt8


class VideoWriter:
    """Write frames to an .mp4: `with VideoWriter(path, fps) as video: video.write(frame)`.

    Frames go to a temporary file, which is renamed to `path` when the block ends, even with an exception or
    Ctrl-C, so that the frames written so far can be watched. All frames must have the size of the first. An
    odd width or height is padded by repeating the last column or row, since yuv420p requires even sizes.
    """

    def __init__(self, path: str | os.PathLike, fps: float, *, quality: int = 18):
        """
        Args:
            path: the video file, ending in .mp4; missing folders are created.
            fps: frames per second.
            quality: H.264's constant rate factor; 0 is lossless, 18 visually lossless, 51 the worst.

        Raises:
            ValueError: `fps` is not positive, or the path does not end in .mp4.
        """
        self.path = Path(path)
        if not fps > 0:
            raise ValueError(f"fps: expected a positive number, found {fps}")
        if self.path.suffix != ".mp4":
            raise ValueError(f"path: expected a name that ends in .mp4, found {self.path}")
        self._rate, self._quality = f"{fps:.6g}", str(quality)
        self._temporary = self.path.with_name(f".{self.path.stem}.{os.getpid()}.partial.mp4")
        self._shape: tuple[int, ...] | None = None
        self._encoder: _Encoder | None = None

    def write(self, frame: Num[np.ndarray, "..."]) -> None:
        """Append a frame [H, W, 3]: uint8, or floats 0 to 1 (clipped; NaN becomes black).

        Raises:
            ValueError: the frame is not an [H, W, 3] picture or differs in size from the first.
            OSError: ffmpeg failed; the message includes its output.
        """
        pixels = _to_bytes(np.asarray(frame))
        height, width = pixels.shape[:2]
        if self._encoder is None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            even = f"{width + width % 2}x{height + height % 2}"
            self._shape, self._encoder = pixels.shape, self._start(even)
        if pixels.shape != self._shape:
            expected = f"shape {self._shape} like the first frame"
            raise ValueError(f"frame: expected {expected}, found {pixels.shape}")
        self._encoder.write(np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").tobytes())

    def close(self) -> None:
        """Finish the file and rename it to its final name. Without any frame no file is written."""
        if self._encoder is None:
            return
        encoder, self._encoder = self._encoder, None
        try:
            encoder.finish()
            os.replace(self._temporary, self.path)
        finally:
            self._temporary.unlink(missing_ok=True)

    def _start(self, size: str) -> "_Encoder":
        return _Encoder(self._temporary, size=size, rate=self._rate, quality=self._quality)

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *exception) -> None:
        self.close()


class _Encoder:
    """An ffmpeg process that reads raw RGB frames and writes an .mp4."""

    def __init__(self, path: Path, *, size: str, rate: str, quality: str):
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", rate, "-i", "-"]
        # Takes a quarter of the time of x264's default for files no larger; runs film every camera.
        target = ["-c:v", "libx264", "-preset", "veryfast", "-crf", quality]
        target += ["-pix_fmt", "yuv420p", "-movflags", "+faststart"]
        # ffmpeg's matrix for RGB, which old OpenCV assumes too; without a name, browsers take another for
        # videos of 720 rows and more.
        target += ["-colorspace", "smpte170m", "-color_range", "tv"]
        # Its messages go to a file, because an unread pipe would fill up and block it.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115  (`finish` closes it)
        # imageio-ffmpeg's own writer forks with a `preexec_fn`, which may deadlock with JAX's threads.
        self._process = subprocess.Popen(
            [_ffmpeg(), "-y", "-loglevel", "error", *source, *target, f"file:{path}"],
            stdin=subprocess.PIPE,
            stderr=self._messages,
            **_own_process_group(),
        )

    def write(self, data: bytes) -> None:
        """Send data to ffmpeg. Raises OSError with its output if it has stopped."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(data)
        except BrokenPipeError as error:
            self._process.wait()
            raise OSError(f"ffmpeg stopped: {self._read_messages()}") from error

    def finish(self) -> None:
        """Finish the file and end the process. Raises OSError with ffmpeg's output if it failed."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        failed = self._process.wait() != 0
        message = self._read_messages()
        self._messages.close()
        if failed:
            raise OSError(f"ffmpeg could not write the video: {message}")

    def _read_messages(self) -> str:
        self._messages.seek(0)
        return self._messages.read().decode(errors="replace").strip() or "no message"


def read_video_frames(path: str | os.PathLike) -> UInt8[np.ndarray, "T H W 3"]:
    """All frames of a video, RGB.

    Raises:
        FileNotFoundError: there is no file at `path`.
        ValueError: no frame can be read from the file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: expected a video, found no file. Check the path")
    capture, frames = cv2.VideoCapture(str(Path(path).absolute())), []
    while (grabbed := capture.read())[0]:
        frames.append(cv2.cvtColor(grabbed[1], cv2.COLOR_BGR2RGB))
    capture.release()
    if not frames:
        raise ValueError(f"{path}: expected a video, found a file without a readable frame")
    return np.stack(frames)


class Packets(NamedTuple):
    """The packets of a video's pictures; most of them hold one picture each.

    Attributes:
        times: presentation timestamps, seconds, sorted, [n].
        skipped: number of packets that the file's edit list hides.
        sound: whether all have a timestamp and content, none is marked as damaged, and none comes before the
            first key frame.
        codec: ffmpeg's name of the codec; "" if ffmpeg finds no pictures.
    """

    times: Float[np.ndarray, "n"]
    skipped: int
    sound: bool
    codec: str


_KEY, _CORRUPT, _DISCARD = 1, 2, 4  # flags of a packet
_NO_STAMP = -(2**63)


def list_packets(path: str | os.PathLike) -> Packets:
    """The packets of the pictures in a video, without decoding them."""
    what = ["-map", "0:V:0", "-c", "copy", "-copyinkf", "-f", "framecrc", "-"]
    command = [_ffmpeg(), "-v", "error", "-i", f"file:{path}", *what]
    listed = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    unit, codec, rows = 0.0, "", []
    for line in listed.stdout.decode(errors="replace").splitlines():
        if line.startswith("#tb"):
            seconds, _, parts = line.split(":")[1].partition("/")
            unit = int(seconds) / int(parts)
        elif line.startswith("#codec_id"):
            codec = line.split(":")[1].strip()
        elif not line.startswith("#"):
            _, _, stamp, _, size, _, *more = (field.strip() for field in line.split(","))
            flags = next((int(field[2:], 16) for field in more if field.startswith("F=")), _KEY)
            rows.append((int(stamp), int(size), flags))
    stamps, sizes, flags = np.array(rows, np.int64).reshape(-1, 3).T
    shown = (flags & _DISCARD) == 0
    key = stamps[(flags & _KEY) > 0]
    sound = listed.returncode == 0 and not listed.stderr and len(key) > 0 and (stamps[shown] >= key[0]).all()
    sound = sound and bool((stamps != _NO_STAMP).all() and (sizes > 0).all() and not (flags & _CORRUPT).any())
    return Packets(np.sort(stamps[shown]) * unit, int(np.sum(~shown)), bool(sound), codec)


def _to_bytes(frame: np.ndarray) -> np.ndarray:
    if frame.ndim != 3 or frame.shape[2] != 3:
        raise ValueError(f"frame: expected shape [H, W, 3], found {frame.shape}")
    if frame.dtype == np.uint8:
        return frame
    if not np.issubdtype(frame.dtype, np.floating):
        raise ValueError(f"frame: expected uint8 or floats 0 to 1, found dtype {frame.dtype}")
    return np.round(255 * np.clip(np.nan_to_num(frame), 0, 1)).astype(np.uint8)


def _ffmpeg() -> str:
    """The path of ffmpeg. Imported late, since most programs neither read nor write video."""
    import imageio_ffmpeg

    return imageio_ffmpeg.get_ffmpeg_exe()


def _own_process_group() -> dict[str, int]:
    """Options that shield ffmpeg from the terminal's Ctrl-C, as ffmpeg must still finish the file."""
    if os.name == "posix":
        return {"process_group": 0}
    return {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
