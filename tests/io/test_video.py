"""Videos: written files can be played, even after an exception or Ctrl-C."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from gsjax.io.video import VideoWriter, _ffmpeg, read_video_frames


def ramp(index, height=32, width=48):
    frame = np.zeros((height, width, 3))
    frame[..., index % 3] = 0.8
    return frame


def test_frames_come_back_in_order_and_colour(tmp_path):
    path = tmp_path / "deep" / "a.mp4"
    with VideoWriter(path, fps=10) as video:
        for i in range(6):
            video.write(ramp(i))
    frames = read_video_frames(path)
    assert frames.shape == (6, 32, 48, 3)
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame / 255, ramp(i), atol=0.06)
    assert os.listdir(path.parent) == ["a.mp4"]


def test_a_colon_in_a_relative_path_is_no_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with VideoWriter("12:30/a.mp4", fps=10) as video:
        video.write(ramp(0))
    assert len(read_video_frames("12:30/a.mp4")) == 1


def test_a_video_names_its_colour_matrix(tmp_path):
    """Players guess otherwise, and differ from 720 rows on."""
    with VideoWriter(tmp_path / "a.mp4", fps=10) as video:
        video.write(ramp(0))
    told = subprocess.run([_ffmpeg(), "-i", tmp_path / "a.mp4"], capture_output=True, text=True).stderr
    assert "yuv420p(tv, smpte170m" in told


def test_odd_sizes_are_padded_and_bytes_taken(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", fps=29.97) as video:
        video.write(np.full((17, 33, 3), 200, np.uint8))
    frames = read_video_frames(tmp_path / "a.mp4")
    assert frames.shape == (1, 18, 34, 3)
    np.testing.assert_allclose(frames.astype(float), 200, atol=4)


def test_nan_and_values_out_of_range_are_drawn(tmp_path):
    frame = np.full((16, 16, 3), np.nan)
    frame[8:] = 7.0
    with VideoWriter(tmp_path / "a.mp4", fps=5) as video:
        video.write(frame)
    drawn = read_video_frames(tmp_path / "a.mp4")[0]
    assert drawn[:6].max() < 20
    assert drawn[10:].min() > 235


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_the_frames_before_an_exception_can_be_watched(tmp_path, error):
    def record():
        with VideoWriter(tmp_path / "a.mp4", fps=10) as video:
            for i in range(5):
                video.write(ramp(i))
            raise error

    with pytest.raises(error):
        record()
    assert len(read_video_frames(tmp_path / "a.mp4")) == 5


@pytest.mark.skipif(os.name != "posix", reason="sends a POSIX signal")
def test_ctrl_c_at_a_terminal_leaves_a_video(tmp_path):
    program = (
        "import sys, time, numpy as np\n"
        "from gsjax.io.video import VideoWriter\n"
        "with VideoWriter(sys.argv[1], fps=10) as video:\n"
        "    for _ in range(4): video.write(np.zeros((16, 16, 3)))\n"
        "    print('ready', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "a.mp4")],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    assert process.stdout.readline() == b"ready\n"
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)  # to the whole group, like a terminal
    process.wait(timeout=20)
    process.stdout.close()
    assert len(read_video_frames(tmp_path / "a.mp4")) == 4


def test_a_frame_of_another_size_is_refused_and_the_rest_kept(tmp_path):
    def record():
        with VideoWriter(tmp_path / "a.mp4", fps=10) as video:
            video.write(ramp(0))
            video.write(ramp(0, height=30))

    with pytest.raises(ValueError, match=r"expected shape \(32, 48, 3\) .*, found \(30, 48, 3\)"):
        record()
    assert len(read_video_frames(tmp_path / "a.mp4")) == 1


def test_nothing_written_leaves_no_file(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", fps=10):
        pass
    assert not list(tmp_path.iterdir())


def test_bad_arguments_and_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="fps: expected a positive number, found 0"):
        VideoWriter(tmp_path / "a.mp4", fps=0)
    with pytest.raises(ValueError, match=r"ends in \.mp4"):
        VideoWriter(tmp_path / "a.avi", fps=1)
    video = VideoWriter(tmp_path / "a.mp4", fps=1)
    with pytest.raises(ValueError, match="expected uint8 or floats"):
        video.write(np.zeros((4, 4, 3), int))
    with pytest.raises(ValueError, match=r"expected shape \[H, W, 3\], found \(4, 4\)"):
        video.write(np.zeros((4, 4)))
    (tmp_path / "text.mp4").write_text("no video")
    with pytest.raises(ValueError, match=r"text\.mp4: expected a video"):
        read_video_frames(tmp_path / "text.mp4")
    with pytest.raises(FileNotFoundError, match=r"none\.mp4"):
        read_video_frames(tmp_path / "none.mp4")


def test_the_output_of_ffmpeg_is_passed_on_and_no_litter_stays(tmp_path):
    video = VideoWriter(tmp_path / "a.mp4", fps=10)
    with pytest.raises(OSError, match="ffmpeg"):  # noqa: PT012  (it may fail at any write, or at the end)
        for _ in range(3):
            video.write(np.zeros((2, 20000, 3)))  # wider than H.264 can be
        video.close()
    with contextlib.suppress(OSError):
        video.close()
    assert not list(tmp_path.iterdir())
