"""What `write_panoptic` writes is read back as it was."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, open_sequence, read_panoptic, write_panoptic
from gsjax.data.simulated import tabletop

WIDTH, HEIGHT = 8, 6


def test_a_simulated_scene_survives_the_disk(tmp_path):
    scene = tabletop(frames=2, width=64, height=48, cameras=2)
    write_panoptic(scene, tmp_path)
    read = read_panoptic(tmp_path)
    assert read.camera_ids == scene.camera_ids
    for t in range(2):
        for c in range(2):
            np.testing.assert_array_equal(read.image(t, c), scene.image(t, c))
            np.testing.assert_array_equal(read.mask(t, c), scene.mask(t, c))
            np.testing.assert_allclose(read.depth(t, c), scene.depth(t, c), atol=5.1e-5)
    np.testing.assert_array_equal(read.truth.poses, scene.truth.poses)
    np.testing.assert_array_equal(read.truth.label_ids, scene.truth.label_ids)
    np.testing.assert_array_equal(read.times, scene.times)
    np.testing.assert_array_equal(read.viewmats, scene.viewmats)
    assert (read.truth.names, read.truth.robot) == (scene.truth.names, scene.truth.robot)


def test_names_of_labels_survive_the_disk_and_others_are_refused(tmp_path):
    sequence = open_sequence("simulated:tabletop?frames=1&width=32&height=24").select(cameras=[0])
    write_panoptic(replace(sequence, truth=None, label_names={1: "robot", 3: "cup"}), tmp_path)
    found = open_sequence(tmp_path)
    assert found.names_of_labels == {1: "robot", 3: "cup"}
    meta = json.loads((tmp_path / "train_meta.json").read_text())
    message = r"train_meta.json: expected label_names to be names of mask values"
    for names in (["cup"], {"three": "cup"}, {"3": 3}, {"²": "cup"}):
        (tmp_path / "train_meta.json").write_text(json.dumps(meta | {"label_names": names}))
        with pytest.raises(DataError, match=message):
            open_sequence(tmp_path)


def test_writing_needs_the_labels_of_a_tabletop(tmp_path):
    scene = tabletop(frames=1, width=16, height=12, cameras=1)
    truth = replace(scene.truth, label_ids=np.array([1, 2, 3, 4]))
    with pytest.raises(ValueError, match=r"labelled 2, 3, ..., got \[1, 2, 3, 4\]"):
        write_panoptic(replace(scene, truth=truth), tmp_path)


def test_frames_that_share_a_time_are_refused_as_they_could_not_be_read(tmp_path):
    scene = replace(tabletop(frames=2, width=16, height=12), times=np.array([0.5, 0.5]), shared_times=True)
    with pytest.raises(ValueError, match=r"a time of its own for each frame, got 0.5 s in frames 0 and 1"):
        write_panoptic(scene, tmp_path)


def test_frames_without_depth_or_mask_survive_the_disk(tmp_path):
    whole = open_sequence("simulated:tabletop?frames=4&width=16&height=12").select(cameras=[0])
    some = replace(
        whole,
        truth=None,
        load_depth=lambda t, c: None if t == 0 else whole.load_depth(t, c),
        load_mask=lambda t, c: None if t == 1 else whole.load_mask(t, c),
    )
    write_panoptic(some, tmp_path)
    found = read_panoptic(tmp_path)
    assert [found.depth(t, 0) is None for t in range(4)] == [True, False, False, False]
    assert [found.mask(t, 0) is None for t in range(4)] == [False, True, False, False]
    (tmp_path / "seg/0/000003.png").unlink()  # lost, as it is not among those that never were
    with pytest.raises(DataError, match=r"seg/0/000003.png: expected a mask, found no such file"):
        read_panoptic(tmp_path).mask(3, 0)


def _labelled(mask_value, depth=1.0):
    """A sequence whose masks and depths are constant."""
    sequence = replace(tabletop(frames=1, width=WIDTH, height=HEIGHT), truth=None)
    shape = (HEIGHT, WIDTH)
    return replace(
        sequence,
        load_mask=lambda t, c: np.full(shape, mask_value, np.int32),
        load_depth=lambda t, c: np.full(shape, depth, np.float32),
    )


def test_large_labels_survive_the_disk_and_negative_ones_are_refused(tmp_path):
    write_panoptic(_labelled(300), tmp_path / "large")
    assert (read_panoptic(tmp_path / "large").mask(0, 0) == 300).all()
    with pytest.raises(ValueError, match="labels from 0 to 65535, got -1"):
        write_panoptic(_labelled(-1), tmp_path / "negative")


def test_depth_too_far_to_be_saved_is_counted(tmp_path):
    with pytest.warns(
        DataWarning, match=rf"depth of {3 * WIDTH * HEIGHT} pixels farther than 6.553 m is lost"
    ):
        write_panoptic(_labelled(1, depth=8.0), tmp_path)
