"""A video, or frames in a folder, of a static camera, with tool masks."""

import warnings

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_photographs, open_sequence, read_clip
from gsjax.data.tool_masks import check_tool, tool_labels
from gsjax.io.video import VideoWriter
from tests.data import dots

WIDTH, HEIGHT, FRAMES = 64, 48, 5
K = (60.0, 61.0, 32.0, 24.0)
MASKS = [np.where(np.arange(WIDTH) < 8 + t, 255, 0) * np.ones((HEIGHT, 1)) for t in range(FRAMES)]


def grey(t):
    image = np.full((HEIGHT, WIDTH, 3), 40 + 40 * t, np.uint8)
    image[:8] = 0
    return image


def write_masks(folder):
    for t, mask in enumerate(MASKS):
        dots.save(folder / f"{t:03d}.png", mask.astype(np.uint8))


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "clip.mp4"
    with VideoWriter(path, 12.5, quality=1) as writer:
        for t in range(FRAMES):
            writer.write(grey(t))
    write_masks(tmp_path / "tools")
    return path


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "pulling"
    for t in range(FRAMES):
        dots.save(root / f"images/f{t + 7:02d}.png", grey(t))
    write_masks(root / "gt_masks")
    return root


def test_a_video(video):
    sequence = read_clip(video, K=K)
    assert (sequence.name, sequence.num_frames, sequence.camera_ids) == ("clip", FRAMES, (0,))
    np.testing.assert_allclose(sequence.times, np.arange(FRAMES) / 12.5)
    np.testing.assert_allclose(sequence.Ks[3, 0], [[60, 0, 32], [0, 61, 24], [0, 0, 1]])
    np.testing.assert_array_equal(sequence.viewmats[:, 0], np.tile(np.eye(4), (FRAMES, 1, 1)))
    assert abs(sequence.image(3, 0)[20:].mean() - 160) < 4
    assert (sequence.has_depth, sequence.has_masks) == (False, False)
    assert sequence.where("image", 3, 0) == f"{video}, frame 3"


def test_masks_beside_a_video(video):
    sequence = read_clip(video, K=K, masks="tools")
    np.testing.assert_array_equal(sequence.mask(2, 0), MASKS[2] > 0)
    assert sequence.label_names == {1: "tool"}
    (video.parent / "tools/000.png").unlink()
    with pytest.raises(DataError, match=r"tools: expected 5 pictures, one per frame of clip.mp4, found 4"):
        read_clip(video, K=K, masks="tools")
    with pytest.raises(DataError, match=r"nowhere: expected 5 pictures, .* found 0"):
        read_clip(video, K=K, masks="nowhere")


def test_frames_with_masks(folder):
    sequence = open_sequence(folder, ReadOptions(K=K))
    assert (sequence.name, sequence.frame_ids) == ("pulling", (7, 8, 9, 10, 11))
    np.testing.assert_allclose(sequence.times, np.arange(FRAMES) / 30)
    np.testing.assert_array_equal(sequence.image(2, 0), grey(2))
    np.testing.assert_array_equal(sequence.mask(2, 0), MASKS[2] > 0)
    assert sequence.where("mask", 1, 0) == str(folder / "gt_masks/001.png")
    assert sequence.where("image", 1, 0) == str(folder / "images/f08.png")
    black = open_sequence(folder, ReadOptions(K=K, tool="white", masks="gt_masks"))
    np.testing.assert_array_equal(black.mask(0, 0), sequence.mask(0, 0))


def test_frames_may_be_called_as_the_parts_of_another_layout(tmp_path):
    """7-Scenes has folders seq-01, seq-02."""
    for t in range(FRAMES):
        dots.save(tmp_path / f"seq-{t:02d}.png", grey(t))
    write_masks(tmp_path / "tools")
    assert open_sequence(tmp_path, ReadOptions(K=K, masks="tools")).num_frames == FRAMES


def test_frames_in_the_folder_itself(folder):
    for path in (folder / "images").iterdir():
        path.rename(folder / path.name)
    (folder / "gt_masks").rename(folder / "tools")
    with pytest.raises(DataError, match="found 5 photographs without poses"):
        open_sequence(folder)  # they cannot be distinguished from photographs
    sequence = open_sequence(folder, ReadOptions(K=K, masks="tools"))
    np.testing.assert_array_equal(sequence.image(4, 0), grey(4))
    assert sequence.mask(4, 0).any()


def test_intrinsics_are_assumed_if_unknown(video):
    with pytest.warns(DataWarning, match=r"clip.mp4: no intrinsics: assuming .* of 60 degrees; give K"):
        sequence = open_sequence(video)
    focal, _, cx = sequence.Ks[0, 0, 0]
    assert np.degrees(2 * np.arctan(WIDTH / 2 / focal)) == pytest.approx(60)
    assert (cx, sequence.Ks[0, 0, 1, 2]) == (WIDTH / 2, HEIGHT / 2)


def test_masks_that_look_inverted(folder):
    with pytest.warns(DataWarning, match=r"gt_masks: in 5 of 5 frames the tool covers .*--read.tool white"):
        open_sequence(folder, ReadOptions(K=K, tool="black"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        open_sequence(folder, ReadOptions(K=K))


def test_of_many_frames_a_sample_is_checked():
    checked = []
    check_tool(lambda t: checked.append(t) or np.array([[0, 1, 0]]), 1000, "white", "masks")
    assert (len(checked), checked[0], checked[-1]) == (64, 0, 999)


def test_a_tool_is_white_or_black():
    with pytest.raises(ValueError, match="tool: expected 'white' or 'black', found 'grey'"):
        tool_labels(np.zeros((2, 2), int), "grey")  # type checkers reject it, as do annotations under test


def test_depth_without_poses_is_not_dropped_in_silence(folder):
    (folder / "depth").mkdir()
    with pytest.raises(DataError, match=r"expected poses_bounds.npy beside depth/, found no such"):
        open_sequence(folder)


def test_invalid_frames_are_refused(folder, tmp_path):
    dots.save(folder / "images/f08.png", np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(DataError, match=r"f08.png: expected 64x48 pixels as in f07.png, found 10x10"):
        open_sequence(folder, ReadOptions(K=K))
    with pytest.raises(DataError, match=r"expected frames, in images/ or directly in it, found none"):
        read_clip(tmp_path)


def test_without_poses_there_is_nothing_to_fit(video):
    with pytest.raises(DataError, match=r"found a video, which has no poses\. Find them first: gsjax poses"):
        open_photographs(video)
