import json

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_paris
from gsjax.data.open import is_photographs, is_recording
from gsjax.data.simulated import tabletop
from tests.data import dots
from tests.data.written import write_paris

HINGE = {"axis": {"o": [1.0, 0, 0], "d": [0, 0, 2.0]}, "type": "rotate", "rotate": {"l": -30.0, "r": 60.0}}
SLIDER = {"axis": {"o": [0, 0, 0], "d": [0, 1.0, 0]}, "type": "translate", "translate": {"l": 0.1, "r": 0.4}}


@pytest.fixture(scope="module")
def scene():
    return tabletop(frames=3, width=32, height=24, cameras=3, moving_cameras=True)


@pytest.fixture
def folder(scene, tmp_path):
    write_paris(scene, tmp_path / "box")
    return tmp_path / "box"


def change(path, edit):
    described = json.loads(path.read_text())
    edit(described)
    path.write_text(json.dumps(described))


def test_states_are_read_as_they_were_written(folder, scene):
    read = open_sequence(folder)
    assert is_recording(folder)
    assert not is_photographs(folder)
    assert (read.name, read.camera_ids, read.frame_ids) == ("box", (0, 1, 2), (0, 1))
    assert (read.times.tolist(), read.truth, read.has_masks) == ([0.0, 1.0], None, False)
    np.testing.assert_allclose(read.Ks, scene.Ks[[0, 2]])
    np.testing.assert_allclose(read.viewmats, scene.viewmats[[0, 2]], atol=1e-12)
    for t, u in ((0, 0), (1, 2)):
        for c in range(3):
            opaque = scene.mask(u, c)[..., None] > 0
            np.testing.assert_array_equal(read.image(t, c), np.where(opaque, scene.image(u, c), 0))
            np.testing.assert_allclose(read.depth(t, c), scene.depth(u, c), atol=5.1e-4)
    assert read.where("depth", 1, 2).endswith("box/end/train/depth/0002.png")


def test_another_split_pictures_in_a_folder_of_their_own_and_no_depth(folder, scene):
    write_paris(scene.select(cameras=[1]), folder, split="test")
    for state in ("start", "end"):
        (folder / state / "test/rgba").mkdir()
        (folder / state / "test/0000.png").rename(folder / state / "test/rgba/0000.png")
        for file in (folder / state / "test/depth").iterdir():
            file.unlink()
        (folder / state / "test/depth").rmdir()
    read = open_sequence(folder, ReadOptions(split="test"))
    assert (read.camera_ids, read.has_depth) == ((0,), False)
    np.testing.assert_allclose(read.viewmats, scene.viewmats[[0, 2], 1:2], atol=1e-12)


@pytest.mark.parametrize("place", ["trans.json", "gt/trans.json", "textured_objs/trans.json"])
def test_true_joints(folder, place):
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_text(json.dumps({"trans_info": [HINGE, SLIDER]}))
    truth = open_sequence(folder).truth
    hinge, slider = truth.joints
    assert (hinge.kind, slider.kind, truth.names) == ("revolute", "prismatic", ("part 1", "part 2"))
    np.testing.assert_allclose(hinge.axis, [0, 0, 1])
    np.testing.assert_allclose(np.rad2deg(hinge.values), [-30, 60])
    # A quarter turn about z through (1, 0, 0) takes (2, 0, 0) to (1, 1, 0).
    turn = truth.poses[1, 0] @ np.linalg.inv(truth.poses[0, 0])
    np.testing.assert_allclose(turn @ [2, 0, 0, 1], [1, 1, 0, 1], atol=1e-12)
    slide = truth.poses[1, 1] @ np.linalg.inv(truth.poses[0, 1])
    np.testing.assert_allclose(slide[:3, 3], [0, 0.3, 0])


def test_one_joint_without_a_list(folder):
    (folder / "trans.json").write_text(json.dumps({"trans_info": SLIDER}))
    assert [joint.kind for joint in read_paris(folder).truth.joints] == ["prismatic"]


def test_cameras_without_a_partner_are_counted(folder):
    (folder / "end/train/0001.png").unlink()
    change(folder / "start/camera_train.json", lambda cameras: cameras["0002"][0].__setitem__(3, np.nan))
    with pytest.warns(
        DataWarning, match=r"2 of 3 cameras lack a picture or a pose in a state .*\(0001, 0002\)"
    ):
        assert read_paris(folder).camera_ids == (0,)
    change(folder / "start/camera_train.json", lambda cameras: cameras.pop("0000"))
    with pytest.raises(DataError, match="found 1 in start and 2 in end, none in both"):
        read_paris(folder)


def test_names_that_are_no_numbers_are_counted(folder):
    for state in ("start", "end"):
        for name, new in (("0000", "left"), ("0001", "right")):
            change(
                folder / state / "camera_train.json",
                lambda cameras, name=name, new=new: cameras.update({new: cameras.pop(name)}),
            )
            for kind in ("", "depth/"):
                (folder / state / f"train/{kind}{name}.png").rename(folder / state / f"train/{kind}{new}.png")
    assert read_paris(folder).camera_ids == (0, 1, 2)


def test_a_state_that_is_missing(folder):
    with pytest.raises(DataError, match=r"start/camera_val.json: expected a JSON file, found no such file"):
        read_paris(folder, split="val")
    dots.save(folder / "end/train/0000.png", np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(DataError, match=r"end/train/0000.png: expected 32x24 pixels, found 5x5"):
        open_sequence(folder).image(1, 0)
