import shutil

import cv2
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_seven_scenes
from tests.data.scene_helpers import depths_from_another_frame

WALL_M, BOX_M = 2.0, 1.0
COLOR_FOCAL, DEPTH_FOCAL, BASELINE_M = 525.0, 585.0, 0.025


def write_pose(path, pose):
    path.write_text("\n".join(" ".join(f"{x:.7e}" for x in row) for row in pose) + "\n")


def pose_at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def write_frame(root, number, x=0.0, ending="png"):
    """Writes a blue wall and a red box in front of it, as the colour and the depth camera see them."""
    root.mkdir(exist_ok=True)
    v, u = np.mgrid[:480, :640] + 0.5

    def on_box(focal, beside):
        across = (u - 320) / focal * BOX_M + beside
        return (np.abs(across) < 0.2) & (np.abs((v - 240) / focal * BOX_M) < 0.2)

    depth = np.where(on_box(DEPTH_FOCAL, 0.0), 1e3 * BOX_M, 1e3 * WALL_M).astype(np.uint16)
    depth[:10], depth[10:20] = 0, 65535
    color = np.zeros((480, 640, 3), np.uint8)
    box = on_box(COLOR_FOCAL, BASELINE_M)
    color[box], color[~box] = (20, 20, 230), (230, 20, 20)  # blue comes first in OpenCV
    stem = root / f"frame-{number:06d}"
    assert cv2.imwrite(f"{stem}.color.{ending}", color)
    assert cv2.imwrite(f"{stem}.depth.png", depth)
    write_pose(root / f"frame-{number:06d}.pose.txt", pose_at(x))


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "seq-01"
    for number in (0, 1, 2, 5):
        write_frame(root, number, x=0.1 * number, ending="jpg" if number == 2 else "png")
    return root


def test_frames_times_and_poses(folder):
    sequence = open_sequence(folder)
    assert sequence.frame_ids == (0, 1, 2, 5)
    np.testing.assert_allclose(sequence.times, np.array([0, 1, 2, 5]) / 30)
    assert (sequence.num_cameras, sequence.width, sequence.height) == (1, 640, 480)
    assert sequence.image(2, 0)[0, 0, 2] > 200  # blue, from the JPEG
    assert not sequence.has_masks
    assert sequence.name == f"{folder.parent.name}_seq-01"


def test_the_depth_camera_as_the_files_have_it(folder):
    sequence = read_seven_scenes(folder, register=False)
    np.testing.assert_allclose(sequence.Ks[0, 0], [[585, 0, 320], [0, 585, 240], [0, 0, 1]])
    np.testing.assert_allclose(sequence.viewmats[3, 0] @ [0.5, 0, 2, 1], [0, 0, 2, 1], atol=1e-12)
    depth = sequence.depth(0, 0)
    assert (depth[:20] == 0).all()  # 0 and 65535
    assert set(np.unique(depth[20:])) == {np.float32(BOX_M), np.float32(WALL_M)}


def test_depth_is_carried_over_to_the_colour_camera(folder):
    """Near depth coincides with the red box, except for the strip that is hidden from the depth camera."""
    sequence = read_seven_scenes(folder)
    np.testing.assert_allclose(sequence.Ks[0, 0], [[525, 0, 320], [0, 525, 240], [0, 0, 1]])
    np.testing.assert_allclose(sequence.viewmats[0, 0] @ [0, 0, 2, 1], [-BASELINE_M, 0, 2, 1])
    image, depth = sequence.image(0, 0), sequence.depth(0, 0)
    red, near, far = image[..., 0] > 128, depth == np.float32(BOX_M), depth == np.float32(WALL_M)
    assert (red & far).sum() <= 0.01 * red.sum()  # the edge's half pixels
    assert (near & ~red).sum() <= 0.01 * red.sum()
    assert (near & red).sum() >= 0.98 * red.sum()
    hidden = (depth == 0) & ~red
    hidden[:, :60], hidden[:, -60:], hidden[:60], hidden[-60:] = False, False, False, False
    assert hidden.any()  # beside the box
    raw = read_seven_scenes(folder, register=False)
    assert ((raw.depth(0, 0) == np.float32(BOX_M)) & ~red).sum() > 0.1 * red.sum()


def test_a_point_seen_by_the_depth_camera_has_the_same_place_in_the_world(folder):
    def world(sequence, t):
        depth = sequence.depth(t, 0)
        v, u = np.nonzero(depth == np.float32(BOX_M))
        local = np.linalg.inv(sequence.Ks[t, 0]) @ np.stack([u + 0.5, v + 0.5, np.ones(len(u))]) * BOX_M
        back = np.linalg.inv(sequence.viewmats[t, 0])
        return (back[:3, :3] @ local + back[:3, 3:]).mean(axis=1)

    for t in (0, 3):
        raw, registered = (world(read_seven_scenes(folder, register=r), t) for r in (False, True))
        np.testing.assert_allclose(registered, raw, atol=1e-3)
        np.testing.assert_allclose(raw, [0.5 if t else 0.0, 0, BOX_M], atol=1e-3)


@pytest.mark.parametrize("number", ["nan", "-inf", "-1.#IND0000e+000", "1.#QNAN00e+000"])
def test_frames_without_a_pose_are_counted_and_left_out(folder, number):
    (folder / "frame-000001.pose.txt").write_text("\n".join([" ".join([number] * 4)] * 4))
    with pytest.warns(DataWarning, match="1 of 4 frames are left out: 1 without a finite pose"):
        assert read_seven_scenes(folder).frame_ids == (0, 2, 5)


def test_frames_without_an_image_are_counted_and_left_out(folder):
    (folder / "frame-000000.depth.png").unlink()
    (folder / "frame-000005.color.png").unlink()
    with pytest.warns(DataWarning, match="2 of 4 frames are left out: 2 without colour or depth"):
        sequence = read_seven_scenes(folder)
    assert sequence.frame_ids == (1, 2)
    for file in folder.glob("*.depth.png"):
        file.unlink()
    with pytest.raises(DataError, match="a frame with pose, colour and depth, found none of 4: 4 wi"):
        read_seven_scenes(folder)


def test_a_scene_of_several_sequences(folder):
    write_frame(folder.parent / "seq-02", 0)
    with pytest.raises(
        DataError, match=r"found the sequences seq-01, seq-02. Pass one of them, such as .*01"
    ):
        open_sequence(folder.parent)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1 0 0\n0 1 0\n0 0 1\n", r"4 lines of 4 numbers, found shape \(3, 3\)"),
        ("1 0 0 zero\n" * 4, r"found something else \(could not convert string to float: .*'zero'\)"),
        ("1 0 0 0\n0 1\n", "4 lines of 4 numbers, found something else"),
        ("", "4 lines of 4 numbers"),
    ],
)
def test_a_pose_of_another_form(folder, text, says):
    (folder / "frame-000002.pose.txt").write_text(text)
    with pytest.raises(DataError, match=f"frame-000002.pose.txt: .*{says}"):
        read_seven_scenes(folder)


def test_a_pose_that_is_not_a_rotation(folder):
    pose = pose_at(0)
    pose[0, 0] = 1.5
    write_pose(folder / "frame-000005.pose.txt", pose)
    with pytest.raises(ValueError, match=r"frame-000005.pose.txt: R is not a rotation"):
        read_seven_scenes(folder)


def test_intrinsics_of_another_camera(folder):
    K = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
    np.savetxt(folder / "camera-intrinsics.txt", K)
    assert read_seven_scenes(folder).num_frames == 4
    K[0, 0] = 615
    np.savetxt(folder / "camera-intrinsics.txt", K)
    with pytest.raises(DataError, match=r"camera-intrinsics.txt: expected the depth camera of 7-Scenes.*615"):
        read_seven_scenes(folder)


def test_images_of_another_size(folder):
    assert cv2.imwrite(str(folder / "frame-000000.color.png"), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(DataError, match=r"frame-000000.color.png: expected 640x480 pixels, found 320x240"):
        read_seven_scenes(folder).image(0, 0)


def test_the_kitchen(shared_data):
    sequence = read_seven_scenes(shared_data / "seven_scenes_kitchen")
    assert sequence.num_frames == 100
    assert sequence.frame_ids[:3] == (0, 3, 6)
    assert 1.0 < np.median(sequence.depth(0, 0)[sequence.depth(0, 0) > 0]) < 3.0


def test_depth_of_the_kitchen_lies_on_that_of_another_frame(shared_data):
    """Points of one frame, projected into a later one, lie on its depth."""
    sequence = read_seven_scenes(shared_data / "seven_scenes_kitchen")
    measured, expected = depths_from_another_frame(sequence, 0, 10)
    assert np.median(np.abs(measured - expected)[measured > 0]) < 0.015


def test_colour_of_the_kitchen_is_registered(shared_data):
    """Depth edges coincide with colour edges; without registration no more than by chance."""

    def agreement(sequence):
        found = []
        for t in (0, 40, 80):
            grey = cv2.GaussianBlur(cv2.cvtColor(sequence.image(t, 0), cv2.COLOR_RGB2GRAY), (0, 0), 1.5)
            slope = np.hypot(*(cv2.Sobel(grey, cv2.CV_32F, dx, 1 - dx) for dx in (0, 1)))
            depth = sequence.depth(t, 0)
            known = cv2.erode((depth > 0).astype(np.uint8), np.ones((3, 3))) > 0
            farthest, nearest = cv2.dilate(depth, np.ones((3, 3))), cv2.erode(depth, np.ones((3, 3)))
            edge = known & (farthest > 1.05 * nearest) & (depth < nearest + 0.02)
            found.append(slope[edge].mean() / slope[depth > 0].mean())
        return np.mean(found)

    folder = shared_data / "seven_scenes_kitchen"
    assert agreement(read_seven_scenes(folder)) > 1.4
    assert agreement(read_seven_scenes(folder, register=False)) < 1.2


def test_a_folder_name_changes_nothing(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "mine")
    assert open_sequence(tmp_path / "mine").frame_ids == (0, 1, 2, 5)


def test_a_recording_by_ones_own_camera(folder):
    """Its depth is already registered to colour, and it has its own size and unit."""
    for file in folder.glob("frame-*.png"):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(file), image[:240, :320])
    (folder / "frame-000002.pose.txt").unlink()  # its colour is a JPEG
    np.savetxt(folder / "camera-intrinsics.txt", [[300, 0, 160], [0, 310, 120], [0, 0, 1]])
    with pytest.raises(DataError, match=r"registered to colour, give K \(--read.K\)"):
        open_sequence(folder)
    sequence = open_sequence(folder, ReadOptions(K=(300, 310, 160, 120), depth_unit_m=0.002))
    assert (sequence.width, sequence.height) == (320, 240)
    np.testing.assert_array_equal(sequence.Ks[1, 0], [[300, 0, 160], [0, 310, 120], [0, 0, 1]])
    np.testing.assert_allclose(sequence.viewmats[1, 0], pose_at(-0.1), atol=1e-6)
    stored = cv2.imread(str(folder / "frame-000000.depth.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(sequence.depth(0, 0), np.where(stored == 65535, 0, 0.002 * stored), rtol=1e-6)
