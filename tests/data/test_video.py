"""Metadata of a video, and stills from it."""

import numpy as np
import pytest

from gsjax.data import DataError
from gsjax.data.files import picture_size, read_image
from gsjax.data.stills import sharpness, write_stills
from gsjax.data.video import describe_video
from gsjax.io.video import VideoWriter

NOISE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)

SMOOTH = np.repeat(np.outer(np.hanning(48), np.hanning(64))[..., None] * 240, 3, axis=-1).astype(np.uint8)


def write(path, frames, fps=12.5):
    with VideoWriter(path, fps, quality=1) as video:
        for frame in frames:
            video.write(frame)
    return path


def test_size_length_and_rate(tmp_path):
    path = write(tmp_path / "a.mp4", [NOISE] * 7)
    assert describe_video(path) == (64, 48, 7, 12.5)


@pytest.mark.parametrize("content", [b"", b"no video", b"\0\0\0\x18ftypmp42" + bytes(100)])
def test_files_that_are_no_video(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    for call in (describe_video, lambda path: write_stills(path, tmp_path / "stills", 3)):
        with pytest.raises(DataError, match=r"a.mp4: expected a video, found a file that does not open"):
            call(path)
    path.unlink()
    with pytest.raises(DataError, match=r"a.mp4: expected a video, found no such file"):
        describe_video(path)


def test_a_video_that_is_cut_off(tmp_path):
    """The index of a web-optimised mp4 is at its start, so its original length is still known."""
    path = write(tmp_path / "a.mp4", [NOISE, 255 - NOISE] * 10)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert describe_video(path).frames == 20
    names = write_stills(path, tmp_path / "stills", 20)
    assert 1 <= len(names) < 20


def test_the_sharpest_frame_of_each_segment(tmp_path):
    blurred = np.full_like(SMOOTH, SMOOTH.mean())
    frames = [SMOOTH if i in (2, 3, 9) else blurred for i in range(12)]  # none in the second segment of four
    frames[2] = ((SMOOTH.astype(int) + blurred) // 2).astype(np.uint8)
    path = write(tmp_path / "a.mp4", frames)
    names = write_stills(path, tmp_path / "stills", 3)
    assert [name for i, name in enumerate(names) if i != 1] == ["frame_000003.jpg", "frame_000009.jpg"]
    assert 4 <= int(names[1][6:12]) <= 7
    assert picture_size(tmp_path / "stills" / names[0]) == (64, 48)
    still = read_image(tmp_path / "stills" / names[0], 64, 48)
    assert np.abs(still.astype(int) - SMOOTH).mean() < 4
    assert sharpness(NOISE) > 10 * sharpness(SMOOTH) > 10 * sharpness(blurred)


def test_fewer_frames_than_are_asked_for(tmp_path):
    path = write(tmp_path / "a.mp4", [NOISE] * 3)
    assert write_stills(path, tmp_path / "stills", 50) == [f"frame_{i:06d}.jpg" for i in range(3)]
    with pytest.raises(ValueError, match="frames: expected 1 or more, found 0"):
        write_stills(path, tmp_path / "stills", 0)
