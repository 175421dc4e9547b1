import json

import cv2
import numpy as np
import pytest

from gsjax.data import DataError, ReadOptions, open_photographs, open_sequence
from gsjax.io.video import VideoWriter

ONE_PIXEL = cv2.imencode(".png", np.array([[[30, 20, 10]]], np.uint8))[1].tobytes()


def test_built_in_scenes_take_arguments():
    sequence = open_sequence("simulated:tabletop?seed=3&frames=5&width=64&height=48&cameras=2&still=true")
    assert (sequence.num_frames, sequence.num_cameras, sequence.width, sequence.height) == (5, 2, 64, 48)
    assert (sequence.truth.poses[0] == sequence.truth.poses[-1]).all()
    assert sequence.name == "tabletop_seed3"
    assert open_sequence("simulated:tabletop").num_frames == 60


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("simulated:kitchen", "no built-in scene 'kitchen'; available: tabletop, articulated"),
        ("simulated:tabletop?sed=3", "no argument 'sed'; it has: seed, frames"),
        ("simulated:tabletop?seed=x", "seed must be an integer, got 'x'"),
        ("simulated:tabletop?seed=", "seed must be an integer, got ''"),
        ("simulated:tabletop?seed=--5", "seed must be an integer, got '--5'"),
        ("simulated:tabletop?hide=2", "hide must be true or false"),
        ("simulated:tabletop?frames=0", "frames must be at least 1"),
        ("simulated:tabletop?hide=1&leave=1", "at most one"),
    ],
)
def test_invalid_built_in_scenes_are_refused(path, says):
    with pytest.raises(ValueError, match=says):
        open_sequence(path)


def test_folders_that_fit_no_layout(tmp_path):
    with pytest.raises(DataError, match="expected a dataset, found an empty folder"):
        open_sequence(tmp_path)
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(DataError, match=r"Panoptic \(train_meta.json\), push-T \(.*found notes.txt"):
        open_sequence(tmp_path)
    with pytest.raises(DataError, match="found a file"):
        open_sequence(tmp_path / "notes.txt")
    with pytest.raises(DataError, match=r"found nothing there.*simulated:tabletop"):
        open_sequence(tmp_path / "nowhere")


@pytest.mark.parametrize(("name", "cameras"), [("tabletop_0", 3), ("push_t", 3), ("seven_scenes_kitchen", 1)])
def test_recordings_are_recognised(shared_data, name, cameras):
    assert open_sequence(shared_data / name).num_cameras == cameras


@pytest.mark.parametrize(
    ("name", "count", "options"),
    [
        ("icl_living_room", 71, ReadOptions(K=(525, 525, 320, 240))),
        ("tissue_0", 60, ReadOptions(axes="endonerf")),
        ("seven_scenes_kitchen", 100, None),
    ],
)
def test_photographs_are_recognised(shared_data, name, count, options):
    assert open_photographs(shared_data / name, options).num == count


def test_photographs_of_built_in_scenes():
    scene = open_photographs("simulated:tabletop?frames=2&width=32&height=24&cameras=2")
    assert (scene.num, scene.image(3).shape) == (4, (24, 32, 3))


def transforms(root):
    (root / "a.png").write_bytes(ONE_PIXEL)
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    (root / "transforms.json").write_text(json.dumps({"fl_x": 1.0, "frames": [frame]}))


def llff(root):
    (root / "images").mkdir()
    (root / "images/a.png").write_bytes(ONE_PIXEL)
    matrix = np.concatenate([np.eye(3), [[0, 1], [0, 1], [0, 1]]], axis=1)
    np.save(root / "poses_bounds.npy", [[*matrix.ravel(), 1, 2]])


def colmap(root):
    (root / "images").mkdir()
    (root / "images/a.png").write_bytes(ONE_PIXEL)
    (root / "cameras.txt").write_text("1 SIMPLE_PINHOLE 1 1 1 0.5 0.5\n")
    (root / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")


def blender(root):
    transforms(root)
    (root / "transforms.json").rename(root / "transforms_train.json")


@pytest.mark.parametrize(
    ("write", "layout"),
    [(transforms, "nerfstudio"), (blender, "Blender"), (llff, "LLFF"), (colmap, "COLMAP")],
)
def test_photographs_are_no_recording(tmp_path, write, layout):
    write(tmp_path)
    scene = open_photographs(tmp_path, ReadOptions(axes="endonerf" if write is llff else None))
    assert (scene.num, scene.image(0).tolist()) == (1, [[[10, 20, 30]]])
    with pytest.raises(DataError, match=rf"expected a recording .*photographs \({layout} layout\)"):
        open_sequence(tmp_path)


def test_options_for_what_a_folder_leaves_open_are_required(tmp_path):
    llff(tmp_path)
    with pytest.raises(
        ValueError, match=r"does not state the meaning of its columns; set axes \(--read.axes\)"
    ):
        open_photographs(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_8")
    assert open_photographs(tmp_path, ReadOptions(axes="endonerf", images="images_8")).num == 1


def video(root):
    with VideoWriter(root / "clip.mp4", 10) as writer:
        for level in (10, 90):
            writer.write(np.full((16, 16, 3), level, np.uint8))


OTHERS = {"K": (9, 9, 8, 8), "axes": "llff", "depth_unit_m": 0.1, "tool": "black", "pose_unit_m": 2.0}
OTHERS |= {"images": "photos", "masks": "tools", "depth_percentiles": (3, 97), "baseline_m": 0.1}


@pytest.mark.parametrize(
    ("write", "opened", "uses"),
    [
        (transforms, open_photographs, ("depth_unit_m",)),
        (llff, open_photographs, ("axes", "images")),
        (colmap, open_photographs, ("images",)),
        (video, lambda path, options: open_sequence(path / "clip.mp4", options), ("K", "masks", "tool")),
        (None, lambda path, options: open_sequence("simulated:bar?frames=2", options), ()),
        (None, lambda path, options: open_photographs("simulated:bar?frames=2", options), ()),
    ],
)
def test_options_that_a_layout_has_no_use_for_are_refused_by_name(tmp_path, write, opened, uses):
    if write is not None:
        write(tmp_path)
    needed = {"axes": "llff"} if write is llff else {}
    for name in OTHERS.keys() - set(uses):
        flag = "--read." + name.replace("_", "-")
        with pytest.raises(
            ValueError, match=rf"expected options for .* data .*--read.near.*, found {flag}\. Leave"
        ):
            opened(tmp_path, ReadOptions(**needed | {name: OTHERS[name]}))


@pytest.mark.parametrize(("name", "what"), [("depth_unit_m", "depth"), ("tool", "masks")])
def test_options_about_what_the_data_lack_are_refused_by_name(tmp_path, name, what):
    (transforms if name == "depth_unit_m" else video)(tmp_path)
    opened = open_photographs if name == "depth_unit_m" else open_sequence
    path = tmp_path if name == "depth_unit_m" else tmp_path / "clip.mp4"
    flag = "--read." + name.replace("_", "-")
    with pytest.raises(ValueError, match=rf"expected data with {what}, as {flag} is given, found none"):
        opened(path, ReadOptions(K=None if name == "depth_unit_m" else (9, 9, 8, 8), **{name: OTHERS[name]}))


@pytest.mark.parametrize("name", ["depth_unit_m", "pose_unit_m", "baseline_m"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_lengths_are_above_0(name, value):
    with pytest.raises(ValueError, match=f"{name}: expected metres above 0, found"):
        ReadOptions(**{name: value})


def test_one_file_of_photographs(tmp_path):
    transforms(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "mine.json")
    assert open_photographs(tmp_path / "mine.json").num == 1


def test_folders_of_scenes(tmp_path):
    for name in ("f_1.ply", "f_2.ply", "f_3.spz", "f_1_labels.npz", "pic.jpg", "pic.xyz", "cloud.ply"):
        (tmp_path / name).write_text("ply\nproperty float f_dc_0\n" if name[0] == "f" else "ply\n")
    said = (
        r"3 files of Gaussians \(f_1.ply, f_2.ply, f_3.spz\) beside cloud.ply, pic.jpg, pic.xyz. Give a file"
    )
    for read in (open_photographs, open_sequence):
        with pytest.raises(DataError, match=said):
            read(tmp_path)
    for number in range(3):
        (tmp_path / f"{number}.jpg").touch()
    with pytest.raises(DataError, match="found 4 photographs without poses"):
        open_photographs(tmp_path)
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    (clouds / "points3D.ply").write_text("ply\n")
    with pytest.raises(DataError, match=r"the files of a known layout: .*found points3D.ply"):
        open_photographs(clouds)


def test_folders_without_photographs(tmp_path):
    (tmp_path / "notes.md").touch()
    known = r"expected the files of a known layout: nerfstudio \(transforms.json\), Blender .*COLMAP \(.*LLFF"
    with pytest.raises(DataError, match=known):
        open_photographs(tmp_path)
    scenes = r"7-Scenes \(frame-\*.pose.txt or .*photographs \(transforms.json, .*\) are for gsjax fit"
    with pytest.raises(DataError, match=scenes):
        open_sequence(tmp_path)
    for name in ("notes.txt", "nowhere"):
        with pytest.raises(DataError, match="expected a folder with a recording, found nothing there"):
            open_photographs(tmp_path / name)
    (tmp_path / "cam00.mp4").write_bytes(b"")
    with pytest.raises(DataError, match=r"found cam00.mp4"):
        open_photographs(tmp_path)
    (tmp_path / "transforms_train.json").write_text('{"frames": [{"file_path": "gone.png"}]}')
    with pytest.raises(DataError, match=r"found 1 listed, 1 with no file \(gone.png\)"):
        open_photographs(tmp_path)


@pytest.mark.parametrize("place", ["", "images", "photos"])
def test_the_error_for_photographs_without_poses_says_how_to_find_them(tmp_path, place):
    (tmp_path / place).mkdir(exist_ok=True)
    for name in ("a.png", "b.JPG"):
        (tmp_path / place / name).write_bytes(ONE_PIXEL)
    folder = tmp_path / place
    says = rf"found 2 photographs without poses. Find them first: gsjax poses {folder} --out DATASET"
    for opened in (open_photographs, open_sequence):
        with pytest.raises(DataError, match=says):
            opened(tmp_path, ReadOptions(images=place or "images"))


def test_the_error_for_a_video_says_how_to_find_poses(tmp_path):
    (tmp_path / "walk.MOV").write_bytes(b"any")
    with pytest.raises(DataError, match=r"found a video, which has no poses. .*gsjax poses .*walk.MOV --out"):
        open_photographs(tmp_path / "walk.MOV")


@pytest.mark.parametrize("place", ["", "images"])
@pytest.mark.parametrize("suffix", [".HEIC", ".heif", ".NEF", ".jxl"])
def test_photographs_in_formats_that_are_not_read_are_counted(tmp_path, place, suffix):
    (tmp_path / place).mkdir(exist_ok=True)
    for name in "ab":
        (tmp_path / place / f"{name}{suffix}").write_bytes(b"")
    for opened in (open_photographs, open_sequence):
        with pytest.raises(DataError, match=rf"found 2 in a format that is not read \(.*\{suffix}, \.\.\.\)"):
            opened(tmp_path)


def test_a_listed_photograph_of_which_there_is_only_raw_data(tmp_path):
    (tmp_path / "a.CR2").write_bytes(b"")
    (tmp_path / "transforms.json").write_text('{"frames": [{"file_path": "a.jpg"}]}')
    with pytest.raises(
        DataError, match=r"found 1 in a format that is not read \(camera raw: a.CR2\). Develop"
    ):
        open_photographs(tmp_path)
