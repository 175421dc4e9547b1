import json
from functools import cache

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_bop
from gsjax.data.simulated import tabletop
from tests.data import dots
from tests.data.written import write_bop

FRAMES, WIDTH, HEIGHT = 3, 48, 36


@cache
def simulated():
    return tabletop(frames=FRAMES, width=WIDTH, height=HEIGHT, cameras=1, moving_cameras=True)


class Folder:
    """A scene on disk, whose files the tests edit."""

    def __init__(self, root, **options):
        self.root = root
        write_bop(simulated(), root, **options)

    def change(self, name, edit):
        described = json.loads((self.root / name).read_text())
        edit(described)
        (self.root / name).write_text(json.dumps(described))


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path / "test/000007")


@pytest.mark.thorough
def test_a_scene_is_read_as_it_was_written(folder):
    read, scene = open_sequence(folder.root), simulated()
    assert (read.name, read.camera_ids, read.frame_ids) == ("test_000007", (0,), (0, 1, 2))
    np.testing.assert_allclose(read.times, np.arange(3) / 30)
    np.testing.assert_allclose(read.Ks, scene.Ks)  # half a pixel less in the file
    np.testing.assert_allclose(read.viewmats, scene.viewmats, atol=1e-12)
    np.testing.assert_allclose(read.truth.poses, scene.truth.poses, atol=1e-12)
    assert read.truth.names == tuple(f"obj_{number:06d}" for number in (12, 13, 14, 15))
    assert read.names_of_labels == dict(enumerate(read.truth.names, start=1))
    for t in range(FRAMES):
        np.testing.assert_array_equal(read.image(t, 0), scene.image(t, 0))
        np.testing.assert_allclose(read.depth(t, 0), scene.depth(t, 0), atol=5.1e-5)
        labels = scene.mask(t, 0)
        np.testing.assert_array_equal(read.mask(t, 0), np.where(labels > 1, labels - 1, 0))
    assert read.where("image", 1, 0).endswith("000007/rgb/000001.png")


def test_grey_pictures_and_a_unit_of_depth_of_the_user(folder):
    (folder.root / "rgb").rename(folder.root / "gray")
    read = open_sequence(folder.root, ReadOptions(depth_unit_m=2e-4))
    np.testing.assert_allclose(read.depth(0, 0), 2 * simulated().depth(0, 0), atol=2e-4)
    assert read.image(0, 0).shape == (HEIGHT, WIDTH, 3)


def test_a_scene_without_poses_of_its_camera_asks_what_stands_still(tmp_path):
    folder = Folder(tmp_path, posed=False)
    with pytest.raises(
        DataError, match=r"found none. Set world \(--read.world\) .*camera or .* \(12, 13, 14"
    ):
        open_sequence(folder.root)
    read = open_sequence(folder.root, ReadOptions(world="15"))  # the block, which never moves
    block = read.truth.poses[:, 3]
    np.testing.assert_allclose(block, np.broadcast_to(np.eye(4), block.shape), atol=1e-9)
    shift = simulated().truth.poses[0, 3]  # from this world to the simulated one
    np.testing.assert_allclose(shift @ read.truth.poses, simulated().truth.poses, atol=1e-9)
    still = read_bop(folder.root, world="camera")
    np.testing.assert_array_equal(still.viewmats, np.broadcast_to(np.eye(4), (FRAMES, 1, 4, 4)))
    for wrong in ("5", "table"):
        with pytest.raises(ValueError, match=rf"world must be camera or .*12, 13, 14, 15\), got '{wrong}'"):
            read_bop(folder.root, world=wrong)


def test_an_object_that_is_to_be_the_world_must_be_one_and_in_the_frame(folder):
    folder.change("scene_gt.json", lambda gt: gt["0"][2].update(obj_id=15))
    with pytest.raises(DataError, match=r"scene_gt.json: expected one object 15.* found several in frame 0"):
        read_bop(folder.root, world="15")
    with pytest.warns(
        DataWarning, match=r"1 of 3 frames are left out: 1 without a pose of the camera \(000000"
    ):
        assert read_bop(folder.root, world="14").frame_ids == (1, 2)


def test_equal_objects_keep_their_labels_though_their_order_changes(folder):
    """Carton and can become instances of one object; the second frame lists them in the opposite order."""

    def edit(gt):
        for entries in gt.values():
            entries[0]["obj_id"] = entries[1]["obj_id"] = 4
        gt["1"][:2] = gt["1"][1::-1]

    folder.change("scene_gt.json", edit)
    masks = [folder.root / f"mask_visib/000001_00000{i}.png" for i in (0, 1)]
    contents = [file.read_bytes() for file in masks]
    for file, content in zip(masks, contents[::-1], strict=True):
        file.write_bytes(content)
    read, scene = read_bop(folder.root), simulated()
    assert read.truth.names == ("obj_000004_1", "obj_000004_2", "obj_000014", "obj_000015")
    np.testing.assert_allclose(read.truth.poses, scene.truth.poses, atol=1e-12)
    np.testing.assert_array_equal(read.mask(1, 0) == 1, scene.mask(1, 0) == 2)


def test_objects_that_come_and_go_keep_their_masks_but_are_not_in_the_truth(folder):
    folder.change("scene_gt.json", lambda gt: gt["2"].pop())
    with pytest.warns(
        DataWarning, match=r"1 of 4 objects are not in all frames \(obj_000015\); they are left"
    ):
        read = read_bop(folder.root)
    assert read.truth.names == ("obj_000012", "obj_000013", "obj_000014")
    assert read.names_of_labels[4] == "obj_000015"
    assert [4 in read.mask(t, 0) for t in range(FRAMES)] == [True, True, False]
    folder.change("scene_gt.json", lambda gt: gt["2"].clear())
    with pytest.warns(DataWarning, match="4 of 4 objects"):
        assert read_bop(folder.root).truth is None


def test_frames_that_lack_something_are_counted(folder):
    (folder.root / "rgb/000000.png").unlink()
    folder.change("scene_gt.json", lambda gt: gt.pop("1"))
    with pytest.warns(
        DataWarning, match=r"2 of 3 frames are left out: 1 without an image \(000000\), 1 without annotations"
    ):
        assert read_bop(folder.root).frame_ids == (2,)
    (folder.root / "depth/000002.png").unlink()
    with pytest.raises(DataError, match=r"found none of 3: .*, 1 without depth \(000002\)"):
        read_bop(folder.root)


def test_pictures_without_a_camera_are_counted(folder):
    folder.change("scene_camera.json", lambda cameras: cameras.pop("1"))
    with pytest.warns(DataWarning, match=r"1 of 3 frames are left out: 1 without a camera \(000001\)"):
        assert read_bop(folder.root).frame_ids == (0, 2)
    folder.change("scene_camera.json", lambda cameras: cameras.clear())
    with pytest.raises(DataError, match=r"found none of 3: 3 without a camera"):
        read_bop(folder.root)


@pytest.mark.parametrize("name", ["scene_camera.json", "scene_gt.json"])
def test_frames_that_a_file_has_twice_are_refused(folder, name):
    folder.change(name, lambda entries: entries.update({"01": entries["1"]}))
    with pytest.raises(DataError, match=rf"{name}: .* a second entry of frame 1\) in '01'"):
        read_bop(folder.root)


def test_pictures_of_one_number_are_refused(folder):
    (folder.root / "rgb/1.png").write_bytes((folder.root / "rgb/000001.png").read_bytes())
    with pytest.raises(DataError, match=r"rgb: expected one picture of each number, found 000001.png and 1"):
        read_bop(folder.root)


def test_masks_that_do_not_exist_are_counted(folder):
    (folder.root / "mask_visib/000001_000003.png").unlink()
    for i in range(4):
        (folder.root / f"mask_visib/000002_{i:06d}.png").unlink()
    with pytest.warns(
        DataWarning, match=r"5 of 12 masks do not exist \(000001_000003.png, 000002_000000.png"
    ):
        read = read_bop(folder.root)
    assert set(np.unique(read.mask(1, 0))) == {0, 1, 2, 3}
    assert read.mask(2, 0) is None


def test_what_is_optional(folder):
    for file in (folder.root / "depth").iterdir():
        file.unlink()
    (folder.root / "scene_gt.json").unlink()
    with pytest.warns(DataWarning, match="mask_visib: no mask belongs to an instance in scene_gt.json"):
        read = read_bop(folder.root)
    assert (read.has_depth, read.has_masks, read.truth) == (False, False, None)
    assert read.depth(0, 0) is None
    assert read.where("depth", 0, 0) == str(folder.root / "depth/000000.png")


def test_folders_that_are_no_scene(folder):
    dots.save(folder.root.parent / "000002/rgb/000000.png", np.zeros((2, 2, 3), np.uint8))
    (folder.root.parent / "000002/scene_camera.json").write_text("{}")
    with pytest.raises(
        DataError, match=r"found the scenes 000002, 000007. Pass one of them, such as .*000002"
    ):
        open_sequence(folder.root.parent)
    with pytest.raises(DataError, match="found none"):
        open_sequence(folder.root.parent / "000002")
    (folder.root / "scene_camera.json").rename(folder.root / "scene_camera_rgb.json")
    with pytest.raises(DataError, match=r"found a scene of several cameras \(scene_camera_rgb.json\)"):
        open_sequence(folder.root)
    (folder.root / "scene_camera_rgb.json").unlink()
    with pytest.raises(DataError, match=r"found no scene_camera.json"):
        read_bop(folder.root)


CORNERS_MM = np.array([[30, 20, 10], [-30, 20, 10], [0, -20, 10], [0, 0, -30.0]])
HALF_TURN = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 4, 0, 0, 0, 1]


def write_models(dataset, numbers, entry):
    """Writes models_eval with the same four vertices for all `numbers` and one entry for 12, 13 and 99."""
    folder = dataset / "models_eval"
    folder.mkdir()
    (folder / "models_info.json").write_text(json.dumps({str(number): entry for number in (12, 13, 99)}))
    header = ["ply", "format ascii 1.0", "element vertex 4", *(f"property float {axis}" for axis in "xyz")]
    header += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, corner)) for corner in CORNERS_MM]
    for number in numbers:
        (folder / f"obj_{number:06d}.ply").write_text("\n".join([*header, *rows, "3 0 1 2", ""]))
    return folder


def test_models_of_objects_are_read_in_metres(folder, tmp_path):
    assert open_sequence(folder.root).truth.models == ()
    continuous = {"axis": [0, 0, 2], "offset": [10, 0, 0]}
    write_models(tmp_path, (12, 14), {"diameter": 80.0, "symmetries_discrete": [HALF_TURN], "min_x": -30})
    model, *others = open_sequence(folder.root).truth.models
    assert others == [None, None, None]  # 13 has no vertices, 14 no entry, 15 neither
    assert (model.source, model.diameter) == ("models_eval/obj_000012.ply", pytest.approx(0.08))
    np.testing.assert_allclose(model.points, CORNERS_MM / 1000, atol=1e-9)
    np.testing.assert_array_equal(model.symmetries[0], np.eye(4))
    np.testing.assert_allclose(model.symmetries[1:, :3, 3], [[0, 0, 0.004]])
    described = {"diameter": 80, "symmetries_discrete": [HALF_TURN], "symmetries_continuous": [continuous]}
    (tmp_path / "models_eval/models_info.json").write_text(json.dumps({"12": described}))
    symmetries = open_sequence(folder.root).truth.models[0].symmetries
    assert len(symmetries) == 2 * 315  # every rotation, alone and after the discrete symmetry
    np.testing.assert_allclose(symmetries[0], np.eye(4), atol=1e-12)
    on_the_axis = np.array([0.01, 0, 0.5, 1])
    alone, after = symmetries[::2], symmetries[1::2]
    np.testing.assert_allclose(alone @ on_the_axis, np.tile(on_the_axis, (315, 1)), atol=1e-12)
    np.testing.assert_allclose(after[100], alone[100] @ after[0], atol=1e-12)
    turned = np.degrees(np.arctan2(alone[:, 1, 0], alone[:, 0, 0])) % 360
    np.testing.assert_allclose(turned, 360 / 315 * np.arange(315), atol=1e-6)


@pytest.mark.parametrize(
    ("entry", "found"),
    [
        ({}, "KeyError: 'diameter'"),
        ({"diameter": 0}, "diameter is 0"),
        ({"diameter": 1, "symmetries_discrete": [[1, 2]]}, "cannot reshape"),
        ({"diameter": 1, "symmetries_discrete": [(2 * np.eye(4)).tolist()]}, "symmetry of place 0"),
        ({"diameter": 1, "symmetries_continuous": [{"axis": [0, 0, 0]}]}, r"axis is \[0. 0. 0.\]"),
    ],
)
def test_malformed_models_are_named(folder, tmp_path, entry, found):
    write_models(tmp_path, (12,), entry)
    with pytest.raises(DataError, match=rf"models_info.json.*object number.*{found}"):
        read_bop(folder.root)


def test_a_model_without_vertices_is_named(folder, tmp_path):
    models = write_models(tmp_path, (12,), {"diameter": 80})
    file = models / "obj_000012.ply"
    header = ["ply", "format ascii 1.0", "element vertex 0", *(f"property float {axis}" for axis in "xyz")]
    file.write_text("\n".join([*header, "end_header", ""]))
    with pytest.raises(DataError, match=r"obj_000012\.ply.*a model with vertices"):
        read_bop(folder.root)
    file.write_text("solid")
    with pytest.raises(DataError, match=r"obj_000012\.ply"):
        read_bop(folder.root)
