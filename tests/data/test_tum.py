import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_tum

START = 1305031102.0
RATE, FRAMES = 30.0, 6


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


class Folder:
    """Colour at 30 Hz, depth 4 ms later, and poses at 100 Hz of a camera that moves and rotates."""

    def __init__(self, root, size=(640, 480)):
        self.root, self.size = root, size
        self.colors = {START + t / RATE: f"rgb/{t}.png" for t in range(FRAMES)}
        self.depths = {stamp + 0.004: f"depth/{t}.png" for t, stamp in enumerate(self.colors)}
        self.poses = {START + i / 100: self.pose(i / 100) for i in range(-5, 30)}
        for t in range(FRAMES):
            image = np.full((size[1], size[0], 3), (200, 10 * t, 20), np.uint8)  # blue, in OpenCV's order
            image[: size[1] // 2] = 90
            save(root / f"rgb/{t}.png", image)
            save(root / f"depth/{t}.png", np.full(size[::-1], 5000 + 500 * t, np.uint16))

    @staticmethod
    def pose(seconds):
        """At 0.4 m/s along x, rotating at 1 rad/s about y."""
        turn = Rotation.from_rotvec([0, seconds, 0])
        return [0.4 * seconds, 1.0, 2.0, *turn.as_quat()]

    def write(self):
        for name in ("rgb", "depth"):
            listed = {"rgb": self.colors, "depth": self.depths}[name]
            lines = [f"{stamp:.6f} {file}" for stamp, file in listed.items()]
            (self.root / f"{name}.txt").write_text("\n".join([f"# {name} images", "", *lines]) + "\n")
        lines = [f"{t:.4f} " + " ".join(f"{x:.7f}" for x in pose) for t, pose in self.poses.items()]
        (self.root / "groundtruth.txt").write_text("# ground truth\n" + "\n".join(lines) + "\n")

    def read(self, **options):
        self.write()
        return read_tum(self.root, **options)


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path / "rgbd_dataset_freiburg3_desk")


def test_the_layout(folder):
    folder.write()
    sequence = open_sequence(folder.root)
    assert sequence.frame_ids == tuple(range(FRAMES))
    np.testing.assert_allclose(sequence.times - START, np.arange(FRAMES) / RATE, atol=1e-6)
    assert sequence.image(2, 0)[-1, 0].tolist() == [20, 20, 200]
    assert (sequence.depth(3, 0) == np.float32(1.3)).all()  # 5000 steps a metre
    np.testing.assert_allclose(sequence.Ks[0, 0], [[535.4, 0, 320.6], [0, 539.2, 248.1], [0, 0, 1]])


def test_poses_are_interpolated_between_those_around_a_frame(folder):
    """The camera moves at 0.4 m/s and 1 rad/s; frame 1 lies a third of the way between two poses."""
    sequence = folder.read()
    for t in range(FRAMES):
        seconds = t / RATE
        expected = np.eye(4)
        expected[:3, :3] = Rotation.from_rotvec([0, seconds, 0]).as_matrix()
        expected[:3, 3] = 0.4 * seconds, 1.0, 2.0
        np.testing.assert_allclose(np.linalg.inv(sequence.viewmats[t, 0]), expected, atol=2e-5)
    ahead = sequence.viewmats[0, 0] @ [0, 1, 5, 1]
    np.testing.assert_allclose(ahead, [0, 0, 3, 1], atol=1e-6)  # it looks along +z, y down


def test_lines_need_not_be_in_order(folder):
    expected = folder.read()
    folder.colors = dict(reversed(folder.colors.items()))
    folder.poses = dict(sorted(folder.poses.items(), key=lambda item: item[1][4]))
    folder.depths = dict(sorted(folder.depths.items(), key=lambda item: item[1][::-1]))
    sequence = folder.read()
    np.testing.assert_array_equal(sequence.times, expected.times)
    np.testing.assert_array_equal(sequence.viewmats, expected.viewmats)
    for t in range(FRAMES):
        np.testing.assert_array_equal(sequence.image(t, 0), expected.image(t, 0))
        np.testing.assert_array_equal(sequence.depth(t, 0), expected.depth(t, 0))


def test_a_stamp_that_occurs_twice(folder):
    folder.write()
    listed = folder.root / "rgb.txt"
    listed.write_text(listed.read_text() + f"{START:.6f} rgb/5.png\n")
    with pytest.warns(DataWarning, match=r"rgb.txt: 1 of 7 lines repeat a stamp"):
        sequence = read_tum(folder.root)
    assert sequence.num_frames == FRAMES
    assert sequence.image(0, 0)[-1, 0, 1] == 0  # the first of the two


def test_frames_without_depth_or_pose_are_counted_and_left_out(folder):
    folder.depths = {stamp: file for stamp, file in folder.depths.items() if file != "depth/1.png"}
    folder.poses = {stamp: pose for stamp, pose in folder.poses.items() if stamp < START + 0.135}
    with pytest.warns(
        DataWarning, match=r"2 of 6 .*: 1 without depth \(.*, 1 without pose \(.* within 20 ms"
    ):
        sequence = folder.read()
    assert sequence.frame_ids == (0, 2, 3, 4)
    assert [float(sequence.depth(t, 0)[0, 0]) for t in range(4)] == pytest.approx([1.0, 1.2, 1.3, 1.4])
    with pytest.warns(DataWarning, match=r"1 of 6 frames"):
        assert folder.read(max_skew=0.03).frame_ids == (0, 1, 2, 3, 4)
    assert folder.read(max_skew=0.1).num_frames == FRAMES


def test_clocks_that_never_meet(folder):
    folder.depths = {stamp + 60: file for stamp, file in folder.depths.items()}
    with pytest.raises(DataError, match=r"the nearest depth is 60 s away.*one clock"):
        folder.read()


def test_files_that_are_listed_but_missing(folder):
    (folder.root / "rgb/0.png").unlink()
    (folder.root / "depth/4.png").unlink()
    with pytest.warns(DataWarning) as caught:
        sequence = folder.read()
    assert sequence.frame_ids == (1, 2, 3, 5)
    messages = [str(warning.message) for warning in caught]
    for name in ("rgb.txt", "depth.txt"):
        assert any(f"{name}: 1 of 6 files do not exist" in message for message in messages)
    for file in folder.root.glob("rgb/*"):
        file.unlink()
    with pytest.raises(DataError, match=r"rgb.txt: expected files that exist, found none of 6, for example"):
        read_tum(folder.root)


def test_poses_that_are_not_finite(folder):
    folder.poses[START + 5 / 100] = [np.nan] * 7
    with pytest.warns(DataWarning, match=r"groundtruth.txt: 1 of 35 poses are not finite"):
        sequence = folder.read()
    assert sequence.num_frames == FRAMES
    assert np.isfinite(sequence.viewmats).all()


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt"])
@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1305031102.5", "in line 4, found '1305031102.5'"),
        ("yesterday rgb/0.png", "in line 4, found 'yesterday rgb/0.png'"),
        ("nan rgb/0.png", "in line 4, found 'nan rgb/0.png'"),
        ("1305031102.5 1 2 3", "in line 4"),
    ],
)
def test_lines_of_another_form(folder, name, line, says):
    folder.write()
    lines = (folder.root / name).read_text().splitlines()
    lines.insert(3, line)
    (folder.root / name).write_text("\n".join(lines))
    with pytest.raises(DataError, match=f"{name}: expected 'stamp .*{says}"):
        read_tum(folder.root)


def test_invalid_quaternions_are_refused(folder):
    folder.poses[START] = [0, 0, 0, 0, 0, 0, 0]
    with pytest.raises(
        DataError, match=r"groundtruth.txt, .* s: expected a quaternion of length 1, found one of length 0"
    ):
        folder.read()
    folder.poses[START] = [0, 0, 0, 1, 2, 3, 4]
    with pytest.raises(DataError, match=r"1305031102.000000 s: .* found one of length 5.48"):
        folder.read()
    folder.write()
    truth = folder.root / "groundtruth.txt"
    truth.write_text(truth.read_text() + "1305031109.0 1 2 three 0 0 0 1\n")
    with pytest.raises(DataError, match=r"groundtruth.txt: expected numbers only, found .*three"):
        read_tum(folder.root)


@pytest.mark.parametrize("name", ["depth.txt", "groundtruth.txt"])
def test_missing_and_empty_lists(folder, name):
    folder.write()
    (folder.root / name).write_text("# nothing\n")
    with pytest.raises(DataError, match=rf"{name}: expected lines 'stamp .*found none"):
        open_sequence(folder.root)
    (folder.root / name).write_bytes(b"\xff\xfe\x80")
    with pytest.raises(DataError, match=rf"{name}: .*found binary data"):
        open_sequence(folder.root)
    (folder.root / name).unlink()
    with pytest.raises(DataError, match=rf"{name}: expected lines 'stamp .*found no such file"):
        open_sequence(folder.root)


def test_a_folder_whose_name_does_not_identify_the_camera(tmp_path):
    folder = Folder(tmp_path / "desk", size=(64, 48))
    with pytest.raises(
        DataError, match=r"freiburg1, freiburg2 or .*found 'desk'.*Give the camera's intrinsics as K \("
    ):
        folder.read()


@pytest.mark.parametrize("name", ["desk", "my_fr1_room"])
def test_a_recording_by_ones_own_camera(tmp_path, name):
    folder = Folder(tmp_path / name, size=(64, 48))
    folder.write()
    K = np.array([[50.0, 0, 32], [0, 51, 24], [0, 0, 1]])
    with pytest.warns(
        DataWarning, match="5000 steps a metre, as none is given for this camera; if it measures"
    ):
        assert (folder.read(K=K).depth(0, 0) == 1).all()
    for sequence in (
        folder.read(K=K, depth_unit_m=0.001),
        open_sequence(folder.root, ReadOptions(K=(50, 51, 32, 24), depth_unit_m=0.001)),
    ):
        np.testing.assert_array_equal(sequence.Ks[0, 0], K)
        assert (sequence.width, sequence.height) == (64, 48)
        assert (sequence.depth(0, 0) == 5).all()
        assert sequence.image(2, 0)[-1, 0].tolist() == [20, 20, 200]  # no published lens is undone


def test_the_published_intrinsics_hold_for_one_size(tmp_path):
    folder = Folder(tmp_path / "fr2_desk", size=(64, 48))
    with pytest.raises(DataError, match=r"rgb/0.png: expected 640x480 pixels.*freiburg2.*found 64x48"):
        folder.read()


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "focal"), [("freiburg1", 517.3), ("freiburg2", 520.9), ("fr1", 517.3)])
def test_lenses_are_undistorted_as_by_opencv(tmp_path, name, focal):
    folder = Folder(tmp_path / f"rgbd_dataset_{name}_xyz")
    v, u = np.mgrid[:480, :640]
    smooth = np.stack([u / 3, v / 3, (u + v) / 5], -1).astype(np.uint8)
    save(folder.root / "rgb/0.png", smooth[..., ::-1])
    save(folder.root / "depth/0.png", (5000 + 8 * u).astype(np.uint16))
    sequence = folder.read()
    K = sequence.Ks[0, 0].copy()
    assert K[0, 0] == focal
    K[:2, 2] -= 0.5  # OpenCV counts centres at integers
    coeffs = {
        "freiburg2": (0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    }.get(name, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    inside = (slice(30, 450), slice(30, 610))
    expected = cv2.undistort(smooth, K, np.array(coeffs))
    assert np.abs(sequence.image(0, 0).astype(int) - expected)[inside].max() <= 2
    x, _ = cv2.initUndistortRectifyMap(K, np.array(coeffs), np.eye(3), K, (640, 480), cv2.CV_32FC1)
    np.testing.assert_allclose(sequence.depth(0, 0)[inside], (5000 + 8 * x[inside]) / 5000, atol=0.0009)
    dark = (sequence.image(0, 0) == 0).all(-1)
    assert (sequence.depth(0, 0)[0, 0] == 0) == dark[0, 0]


@pytest.mark.thorough
def test_beyond_the_photograph_is_black_and_without_depth(tmp_path):
    folder = Folder(tmp_path / "own", size=(64, 48))
    for t in range(FRAMES):
        save(folder.root / f"rgb/{t}.png", np.full((48, 64, 3), 100, np.uint8))
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    sequence = folder.read(K=K, distortion=(0.4, 0.0, 0.0, 0.0))
    image, depth = sequence.image(0, 0), sequence.depth(0, 0)
    assert (depth[0] == 0).all()
    assert (image[0] == 0).all()
    assert (image[24, 32] == 100).all()
    assert set(np.unique(image)) == {0, 100}  # nothing is blended with pixels outside
    np.testing.assert_array_equal(depth == 0, (image == 0).all(-1))
