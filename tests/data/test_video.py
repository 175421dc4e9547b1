"""Metadata of a video, and stills from it."""

import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning
from gsjax.data.files import picture_size, read_image
from gsjax.data.stills import sharpness, write_stills
from gsjax.data.video import Video, describe_video
from gsjax.io.video import VideoWriter

NOISE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)

SMOOTH = np.repeat(np.outer(np.hanning(48), np.hanning(64))[..., None] * 240, 3, axis=-1).astype(np.uint8)


def write(path, frames, fps=12.5):
    with VideoWriter(path, fps, quality=1) as video:
        for frame in frames:
            video.write(frame)
    return path


def converted(path, name, *options):
    """The video converted by ffmpeg; a name such as "-.mkv" makes it a stream, whose header has no length."""
    target = path.with_name(name)
    before = [option for option in options if option.startswith("-display") or option == "90"]
    after = [option for option in options if option not in before]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", *before, "-i", str(path), *after]
    if name.startswith("-"):
        form = {".mkv": "matroska", ".webm": "webm"}[target.suffix]
        target.write_bytes(
            subprocess.run([*command, "-f", form, "-"], capture_output=True, check=True).stdout
        )
    else:
        subprocess.run([*command, "-y", str(target)], check=True)
    return target


def levels(count):
    return [np.full((48, 64, 3), 10 + 6 * t, np.uint8) for t in range(count)]


def level(image):
    return round((float(image.mean()) - 10) / 6)


def frames_of(path, order=None):
    """The numbers encoded in the frames, which are read in the given order."""
    file = describe_video(path)
    video = Video(path, file.width, file.height, file.frames, file)
    return [level(video.frame(t)) for t in (range(file.frames) if order is None else order)]


def test_size_length_and_times(tmp_path):
    path = write(tmp_path / "a.mp4", [NOISE] * 7)
    file = describe_video(path)
    assert (file.width, file.height, file.frames, file.stamped) == (64, 48, 7, True)
    np.testing.assert_allclose(file.times, np.arange(7) / 12.5)


VARYING = [0, 1, 2, 3, 4, 5, 6, 7, 10, 15, 20, 25, 26, 27, 30, 35]


@pytest.mark.parametrize(
    ("name", "codec"),
    [
        ("b.mp4", ["-c:v", "libx264"]),
        ("b.mkv", ["-c:v", "libx264", "-g", "5"]),
        ("b.webm", ["-c:v", "libvpx", "-auto-alt-ref", "1"]),
        ("-.mkv", ["-c:v", "libx264"]),
        ("-.webm", ["-c:v", "libvpx-vp9"]),
    ],
)
def test_each_frame_has_its_own_time(tmp_path, name, codec):
    path = write(tmp_path / "a.mp4", levels(40))
    kept = "+".join(f"eq(n,{n})" for n in VARYING)
    path = converted(path, name, "-vf", f"select='{kept}'", "-fps_mode", "vfr", *codec)
    np.testing.assert_allclose(describe_video(path).times, np.array(VARYING) / 12.5, atol=2e-3)
    assert frames_of(path) == VARYING
    order = [15, 0, 12, 11, 3, 14, 1, 1, 15, 8]
    assert frames_of(path, order) == [VARYING[t] for t in order]
    stills = write_stills(path, tmp_path / "stills", 100)
    assert len(stills) == len(VARYING)


def test_frames_that_cannot_be_decoded_are_counted(tmp_path):
    """Without the first key frame, the frames before the second lack their reference."""
    path = converted(
        write(tmp_path / "a.mp4", levels(30)), "b.mp4", "-c:v", "libx264", "-g", "10", "-bf", "0"
    )
    path = converted(path, "c.mp4", "-c", "copy", "-copyinkf", "-bsf:v", "noise=drop='eq(n,0)'")
    with pytest.warns(DataWarning, match=r"c.mp4: 9 of the 29 frames that the file states cannot be decoded"):
        file = describe_video(path)
    assert file.frames == 20
    np.testing.assert_allclose(file.times, np.arange(20) / 12.5, atol=1e-6)
    with pytest.warns(DataWarning, match="9 of the 29"):
        assert frames_of(path, [0, 19, 4]) == [10, 29, 14]


def test_a_video_is_read_upright(tmp_path):
    halves = np.concatenate([np.full((24, 64, 3), 250, np.uint8), np.zeros((24, 64, 3), np.uint8)])
    path = converted(
        write(tmp_path / "a.mp4", [halves] * 20), "b.mp4", "-display_rotation", "90", "-c", "copy"
    )
    file = describe_video(path)
    assert (file.width, file.height, file.frames) == (48, 64, 20)
    video = Video(path, file.width, file.height, file.frames, file)
    for t in (0, 19, 1):
        left, right = video.frame(t)[:, :20].mean(), video.frame(t)[:, -20:].mean()
        assert (left > 200, right < 50) == (True, True)


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
    with pytest.warns(
        DataWarning, match=r"a.mp4: \d+ of the 20 frames that the file states cannot be decoded"
    ):
        left = describe_video(path).frames
    with pytest.warns(DataWarning, match="cannot be decoded"):
        names = write_stills(path, tmp_path / "stills", 20)
    assert 1 <= len(names) == left < 20


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
