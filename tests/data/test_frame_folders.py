"""Frames in a folder: their order, numbers and sizes, and the pictures that belong to them."""

import warnings

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning
from gsjax.data.frame_folders import (
    check_one_size,
    frame_numbers,
    pictures,
    pictures_beside,
    warn_about_single_frame,
)
from tests.data import dots


def save(folder, *names, size=(8, 6)):
    for name in names:
        dots.save(folder / name, np.zeros((size[1], size[0], 3), np.uint8))


def test_pictures_come_in_order_of_name_and_nothing_else_does(tmp_path):
    save(tmp_path, "b.png", "a.jpg", "c.jpeg", ".thumb.png")
    for name in ("d.MPO", "e.JFIF"):
        (tmp_path / name).write_bytes((tmp_path / "a.jpg").read_bytes() * 2)
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "more.png").mkdir()
    assert [path.name for path in pictures(tmp_path)] == ["a.jpg", "b.png", "c.jpeg", "d.MPO", "e.JFIF"]
    assert pictures(tmp_path / "nowhere") == []


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("frame-000003_color.png", "frame-000007_color.png"), (3, 7)),
        (("2024_clip_01.png", "2024_clip_02.png"), (1, 2)),
        (("a.png", "b3.png"), (0, 1)),
        (("f1_left.png", "f1_right.png"), (0, 1)),
        (("1305031102.975304.png", "1305031103.011304.png"), (0, 1)),
        (("shot1_099.png", "shot2_001.png"), (0, 1)),
        (("left_1.png", "left_2.png", "right_1.png"), (0, 1, 2)),
    ],
)
def test_the_frame_number_is_the_last_number_in_the_name(tmp_path, names, numbers):
    assert frame_numbers([tmp_path / name for name in names]) == numbers


@pytest.mark.parametrize("end", ["", "_cam0", "_v1"])
def test_numbers_without_padding_are_refused(tmp_path, end):
    frames = sorted(tmp_path / f"{i}{end}.png" for i in (2, 3, 10))
    with pytest.raises(DataError, match=rf"found 2{end}.png after 10{end}.png. Pad the numbers with zeros"):
        frame_numbers(frames)


def test_one_size(tmp_path):
    save(tmp_path, "0.png", "1.png")
    assert check_one_size(pictures(tmp_path)) == (8, 6)
    save(tmp_path, "2.png", size=(6, 8))
    with pytest.raises(DataError, match=r"2.png: expected 8x6 pixels as in 0.png, found 6x8"):
        check_one_size(pictures(tmp_path))


def test_there_must_be_one_picture_per_frame(tmp_path):
    save(tmp_path, "masks/0.png")
    with pytest.raises(DataError, match=r"masks: expected 2 pictures, one per frame of clip.mp4, found 1"):
        pictures_beside(tmp_path / "masks", 2, "clip.mp4")
    save(tmp_path, "masks/1.jpg")
    assert len(pictures_beside(tmp_path / "masks", 2, "images")) == 2


def test_pictures_beside_frames_must_sort_in_order_of_their_numbers_too(tmp_path):
    save(tmp_path, "masks/1.png", "masks/2.png", "masks/10.png")
    with pytest.raises(DataError, match=r"masks: .*found 2.png after 10.png. Pad the numbers with zeros"):
        pictures_beside(tmp_path / "masks", 3, "clip.mp4")


def test_a_single_frame_shows_no_motion(tmp_path):
    with pytest.warns(DataWarning, match=r"0.png: it is the only frame"):
        warn_about_single_frame([tmp_path / "0.png"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_about_single_frame([tmp_path / "0.png", tmp_path / "1.png"])
