import json
import warnings

import cv2
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_panoptic

FRAMES, WIDTH, HEIGHT = 3, 8, 6
K = [[10.0, 0.0, 4.0], [0.0, 10.0, 3.0], [0.0, 0.0, 1.0]]


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


class Folder:
    """A small recording on disk; tests change its meta before they write it."""

    def __init__(self, root, cameras=(0, 1), name="train_meta.json"):
        self.root, self.name = root, name
        self.meta = {
            "w": WIDTH,
            "h": HEIGHT,
            "k": [[K for _ in cameras] for _ in range(FRAMES)],
            "w2c": [[np.eye(4).tolist() for _ in cameras] for _ in range(FRAMES)],
            "fn": [[f"{c}/{t:06d}.jpg" for c in cameras] for t in range(FRAMES)],
            "cam_id": [list(cameras) for _ in range(FRAMES)],
        }
        for t in range(FRAMES):
            for c in cameras:
                image = np.full((HEIGHT, WIDTH, 3), 40 * t + 5 * c, np.uint8)
                image[:, : WIDTH // 2] = 20, 30, 220  # red, in OpenCV's order
                save(root / f"ims/{c}/{t:06d}.jpg", image)

    def add(self, kind, c, dtype, value=1):
        for t in range(FRAMES):
            save(self.root / f"{kind}/{c}/{t:06d}.png", np.full((HEIGHT, WIDTH), value, dtype))

    def read(self):
        self.write()
        return read_panoptic(self.root)

    def write(self):
        (self.root / self.name).write_text(json.dumps(self.meta))


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


def test_the_layout_of_the_original(folder):
    sequence = folder.read()
    assert sequence.camera_ids == (0, 1)
    assert sequence.frame_ids == (0, 1, 2)
    np.testing.assert_allclose(sequence.times, np.arange(3) / 30)
    assert not sequence.has_depth
    assert not sequence.has_masks
    assert sequence.truth is None
    assert sequence.image(1, 1)[0, 0, 0] > 180  # red comes first


def test_depth_masks_and_times(folder):
    folder.add("depth", 0, np.uint16, 1500)
    folder.add("depth", 1, np.uint16, 1500)
    folder.add("seg", 1, np.uint8, 3)
    folder.meta |= {"time": [1.0, 1.5, 1.75], "depth_unit_m": 0.002}
    sequence = folder.read()
    np.testing.assert_array_equal(sequence.times, [1.0, 1.5, 1.75])
    assert (sequence.depth(0, 0) == 3).all()
    assert sequence.mask(0, 0) is None  # no folder for this camera
    assert (sequence.mask(0, 1) == 3).all()
    assert sequence.mask(0, 1).dtype == np.int32


def test_depth_is_in_millimetres_by_default(folder):
    folder.add("depth", 0, np.uint16, 1500)
    assert (folder.read().depth(0, 0) == 1.5).all()


def test_saturated_depth_is_invalid(folder):
    folder.add("depth", 0, np.uint16, 1500)
    depth = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    depth[0, :3] = 65535, 0, 1
    save(folder.root / "depth/0/000000.png", depth)
    assert folder.read().depth(0, 0)[0, :3].tolist() == [0, 0, np.float32(0.001)]


def test_both_metas_are_merged(folder):
    Folder(folder.root, cameras=(5,), name="test_meta.json").write()
    sequence = folder.read()
    assert sequence.camera_ids == (0, 1, 5)
    assert sequence.viewmats.shape == (FRAMES, 3, 4, 4)
    assert sequence.select(cameras=[5]).image(2, 0)[0, -1, 0] == pytest.approx(105, abs=3)


def test_frames_without_files_are_counted_and_left_out(folder):
    for c in (0, 1):
        (folder.root / f"ims/{c}/000001.jpg").unlink()
    with pytest.warns(DataWarning, match="1 of 3 frames have no image"):
        sequence = folder.read()
    assert sequence.frame_ids == (0, 2)
    np.testing.assert_allclose(sequence.times, [0, 2 / 30])
    assert sequence.image(1, 0)[0, -1, 0] == pytest.approx(80, abs=3)


def test_a_single_missing_image_is_reported_at_once(folder):
    (folder.root / "ims/1/000001.jpg").unlink()
    with pytest.raises(DataError, match=r"ims/1/000001.jpg: expected images of all 2 cameras in frame 1"):
        folder.read()


def test_no_image_at_all(folder):
    for file in folder.root.glob("ims/*/*"):
        file.unlink()
    with pytest.raises(DataError, match="none of 6"):
        folder.read()


def test_a_camera_count_that_differs_names_the_frame(folder):
    for key in ("k", "w2c", "fn", "cam_id"):
        folder.meta[key][2] = folder.meta[key][2][:1]
    with pytest.raises(DataError, match=r"train_meta.json: expected 2 cameras in k, .* found 1 in frame 2"):
        folder.read()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda m: m.pop("w2c"), "no w2c"),
        (lambda m: m["k"].pop(), "3 frames in k"),
        (lambda m: m["cam_id"][1].reverse(), r"found \[1, 0\] in frame 1"),
        (lambda m: m["w2c"][1][1].pop(), r"w2c in frame 1, camera position 1, as 4x4 numbers, found 3x4"),
        (lambda m: m.update(time=[0.0, 1.0]), "time to be 3 numbers"),
        (lambda m: m.update(fn=[]), "at least one frame"),
        (lambda m: m.update(absent="seg/0/000001.png"), "expected absent to be a list of files, found 'seg"),
        (lambda m: m.update(absent=[[1]]), "the lists and numbers of this layout, found something else"),
        (lambda m: m.update(fn=[[1, 2]] * 3), "the lists and numbers of this layout, found something else"),
    ],
)
def test_a_meta_that_disagrees_with_itself(folder, change, says):
    change(folder.meta)
    with pytest.raises(DataError, match=says) as caught:
        folder.read()
    assert "train_meta.json" in str(caught.value)


def test_metas_that_disagree_with_each_other(folder):
    other = Folder(folder.root, cameras=(1, 5), name="test_meta.json")
    other.write()
    with pytest.raises(DataError, match=r"test_meta.json: .*cameras \[1\] in both"):
        folder.read()
    other.meta["h"] = 100
    other.write()
    with pytest.raises(DataError, match=r"test_meta.json: expected h as in train_meta.json"):
        folder.read()


def test_a_pose_that_is_not_a_rotation(folder):
    folder.meta["w2c"][1][0][0][0] = 3.0
    with pytest.raises(ValueError, match="camera 0 in frame 1: R is not a rotation"):
        folder.read()


def test_missing_and_broken_metas(tmp_path):
    with pytest.raises(DataError, match=r"train_meta.json: expected a JSON file, found no such file"):
        read_panoptic(tmp_path)
    (tmp_path / "train_meta.json").write_text("{")
    with pytest.raises(DataError, match="bad JSON"):
        read_panoptic(tmp_path)


def cut(path):
    path.write_bytes(path.read_bytes()[:-20])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (cut, "a file that is cut off"),
        (lambda path: path.write_bytes(b""), r"something else \(0 bytes\)"),
        (lambda path: path.write_text("no image"), "something else"),
        (lambda path: save(path, np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8)), "8x6 pixels, found 9x6"),
    ],
)
def test_a_bad_image_is_named(folder, spoil, says):
    sequence = folder.read()
    spoil(folder.root / "ims/1/000002.jpg")
    with pytest.raises(DataError, match=f"ims/1/000002.jpg: .*{says}"):
        sequence.image(2, 1)


def test_the_first_mask_may_be_the_only_one(folder):
    folder.add("seg", 0, np.uint8)
    folder.add("seg", 1, np.uint8)
    for file in sorted((folder.root / "seg/0").iterdir())[1:]:
        file.unlink()
    for name in (".DS_Store", "._000000.png", "Thumbs.db"):  # of file managers
        (folder.root / "seg/0" / name).write_bytes(b"")
    sequence = folder.read()
    assert sequence.mask(0, 0) is not None
    assert sequence.mask(1, 0) is None
    assert sequence.mask(1, 1) is not None


def test_files_of_a_kind_that_are_missing_or_bad(folder):
    folder.add("depth", 0, np.uint8, 15)
    folder.add("seg", 0, np.uint8)
    sequence = folder.read()
    with pytest.raises(
        DataError, match=r"depth/0/000000.png: expected depth as one 16-bit channel, found uint8"
    ):
        sequence.depth(0, 0)
    save(folder.root / "seg/0/000000.png", np.zeros((3, 3), np.uint8))
    with pytest.raises(DataError, match=r"seg/0/000000.png: expected 8x6 pixels, found 3x3"):
        sequence.mask(0, 0)
    (folder.root / "seg/0/000001.png").unlink()
    with pytest.raises(DataError, match=r"seg/0/000001.png: expected a mask, found no such file"):
        sequence.mask(1, 0)
    cut(folder.root / "seg/0/000002.png")
    with pytest.raises(DataError, match="cut off"):
        sequence.mask(2, 0)


def test_a_mask_in_colour(folder):
    folder.add("seg", 0, np.uint8)
    sequence = folder.read()
    save(folder.root / "seg/0/000000.png", np.full((HEIGHT, WIDTH, 3), 4, np.uint8))
    assert (sequence.mask(0, 0) == 4).all()
    save(folder.root / "seg/0/000000.png", np.full((HEIGHT, WIDTH, 3), [1, 2, 3], np.uint8))
    with pytest.raises(DataError, match="one label per pixel"):
        sequence.mask(0, 0)


@pytest.mark.parametrize(("unit", "says"), [(1.0, "median of 1500 m"), (1e-6, "median of 0.0015 m")])
def test_a_wrong_depth_unit(folder, unit, says):
    folder.add("depth", 0, np.uint16, 1500)
    folder.meta["depth_unit_m"] = unit
    with pytest.raises(DataError, match=f"depth/0/000000.png: .*{says}.*depth_unit_m"):
        folder.read().depth(0, 0)


def test_depth_of_zeros_warns(folder):
    folder.add("depth", 0, np.uint16, 0)
    with pytest.warns(DataWarning, match="depth/0/000000.png: no pixel has a valid depth"):
        folder.read().depth(0, 0)


@pytest.mark.parametrize(
    ("key", "names_key", "labels", "robot"), [("T_wo", "objects", [2, 3], 1), ("T_wp", "parts", [1, 2], None)]
)
def test_truth(folder, key, names_key, labels, robot):
    poses = np.tile(np.eye(4), (FRAMES, 2, 1, 1))
    poses[2, 1, 0, 3] = 5
    np.savez(folder.root / "truth.npz", **{key: poses})
    (folder.root / "meta.json").write_text(json.dumps({names_key: ["a", "b"]}))
    truth = folder.read().truth
    assert truth.names == ("a", "b")
    assert truth.label_ids.tolist() == labels
    assert truth.robot == robot
    np.testing.assert_array_equal(truth.poses, poses)
    np.savez(folder.root / "truth.npz", **{key: poses[:2]})
    with pytest.raises(DataError, match=r"truth.npz"):
        folder.read()


def test_truth_skips_the_frames_that_have_no_files(folder):
    poses = np.tile(np.eye(4), (FRAMES, 1, 1, 1))
    poses[:, 0, 0, 3] = range(FRAMES)
    np.savez(folder.root / "truth.npz", T_wo=poses)
    (folder.root / "meta.json").write_text(json.dumps({"objects": ["a"]}))
    for c in (0, 1):
        (folder.root / f"ims/{c}/000000.jpg").unlink()
    with pytest.warns(DataWarning, match="1 of 3 frames"):
        assert folder.read().truth.poses[:, 0, 0, 3].tolist() == [1, 2]


@pytest.mark.parametrize("name", ["tabletop_0", "tabletop_1", "articulated_0"])
def test_simulated_recordings(shared_data, name):
    sequence = read_panoptic(shared_data / name)
    assert sequence.has_depth
    assert sequence.has_masks
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for t in (0, sequence.num_frames - 1):
            labels = set(np.unique(sequence.mask(t, 0)))
            assert sequence.image(t, 0).shape == (240, 320, 3)
            assert 0.3 < np.median(sequence.depth(t, 0)) < 5
            assert labels & set(sequence.truth.label_ids.tolist())


def test_truth_of_a_recording_agrees_with_its_depth(shared_data):
    """Points of an object, moved by its pose to another frame, lie on its depth there."""
    sequence = read_panoptic(shared_data / "tabletop_0")
    k = sequence.truth.names.index("Can")
    y, x = np.nonzero(sequence.mask(0, 1) == sequence.truth.label_ids[k])
    K, view = sequence.Ks[0, 1], sequence.viewmats[0, 1]
    local = np.linalg.inv(K) @ np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) * sequence.depth(0, 1)[y, x]
    world = view[:3, :3].T @ (local - view[:3, 3:])
    motion = sequence.truth.poses[30, k] @ np.linalg.inv(sequence.truth.poses[0, k])
    moved = view[:3, :3] @ (motion[:3, :3] @ world + motion[:3, 3:]) + view[:3, 3:]
    u, v = (np.floor((K @ moved)[:2] / moved[2])).astype(int)
    inside = (u >= 0) & (u < sequence.width) & (v >= 0) & (v < sequence.height)
    assert inside.any()
    error = np.abs(sequence.depth(30, 1)[v[inside], u[inside]] - moved[2][inside])
    assert np.median(error) < 0.005


def test_real_recording_with_held_out_cameras(shared_data):
    with pytest.warns(DataWarning, match="120 of 150 frames"):
        sequence = read_panoptic(shared_data / "panoptic_basketball")
    assert sequence.num_frames == 30
    assert sequence.num_cameras == 31
    assert sequence.frame_ids[:3] == (0, 2, 4)
    np.testing.assert_allclose(sequence.times[1], 2 / 30)
    held_out = sequence.select(cameras=[0, 10, 15, 30])
    assert held_out.mask(0, 0) is None
    assert held_out.image(29, 3).shape == (360, 640, 3)
    assert set(np.unique(sequence.mask(0, 0))) == {0, 255}


def test_frames_without_a_number_are_counted(folder):
    for t in range(FRAMES):
        for c in (0, 1):
            (folder.root / f"ims/{c}/{t:06d}.jpg").rename(folder.root / f"ims/{c}/frame_{'abc'[t]}.jpg")
    folder.meta["fn"] = [[f"{c}/frame_{letter}.jpg" for c in (0, 1)] for letter in "abc"]
    assert folder.read().frame_ids == (0, 1, 2)


def test_frames_whose_names_end_in_the_camera_are_counted(folder):
    for name in (folder.root / "ims").glob("*/*"):
        name.rename(name.with_stem(f"{name.stem}_cam{name.parent.name}"))
    folder.meta["fn"] = [[f"{c}/{t:06d}_cam{c}.jpg" for c in (0, 1)] for t in range(FRAMES)]
    assert folder.read().frame_ids == (0, 1, 2)
    folder.meta["w2c"][1][0][0][0] = 3.0
    with pytest.raises(ValueError, match="camera 0 in frame 1: R is not a rotation"):
        folder.read()


def test_a_unit_of_depth_that_the_user_gives(folder):
    folder.add("depth", 0, np.uint16, 500)
    folder.meta["depth_unit_m"] = 0.01
    folder.write()
    assert (open_sequence(folder.root).depth(0, 0) == 5).all()
    assert (open_sequence(folder.root, ReadOptions(depth_unit_m=0.002)).depth(0, 0) == 1).all()
