import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_realsense
from tests.data.realsense_bag import ANGLE, BASELINE_M, BOX_M, WALL_M, image, write

pytest.importorskip(
    "rosbags", reason="recordings of RealSense cameras are ROS bags: pip install 'gsjax[rosbag]'"
)


@pytest.fixture
def bag(tmp_path):
    return write(tmp_path / "desk.bag")


def read(bag, **options):
    with pytest.warns(DataWarning, match="1 of 3 frames are left out: 1 without depth .up to 25 ms"):
        return open_sequence(bag, ReadOptions(**options))


def test_frames_and_camera(bag):
    sequence = read(bag)
    assert (sequence.name, sequence.frame_ids, sequence.num_cameras) == ("desk", (0, 1), 1)
    np.testing.assert_allclose(sequence.times, [1, 1 + 1 / 30])
    np.testing.assert_array_equal(sequence.Ks[1, 0], [[40, 0, 24], [0, 41, 18], [0, 0, 1]])
    np.testing.assert_array_equal(sequence.viewmats[:, 0], np.tile(np.eye(4), (2, 1, 1)))
    np.testing.assert_array_equal(sequence.image(1, 0), image(1))
    assert sequence.where("image", 1, 0).endswith("desk.bag at 1.033 s")


def test_depth_is_where_the_colour_camera_sees_it(bag):
    """The box, on the depth camera's axis, is right of the colour camera's by the baseline."""
    depth = read(bag).depth(0, 0)
    rows, columns = np.nonzero(np.isclose(depth, BOX_M))
    assert 16 <= len(rows) <= 40
    np.testing.assert_allclose(columns.mean() + 0.5, 24 + 40 * BASELINE_M / BOX_M, atol=0.6)
    np.testing.assert_allclose(rows.mean() + 0.5, 18, atol=0.6)
    assert set(np.unique(depth)) <= {0, np.float32(BOX_M), np.float32(WALL_M)}


def test_the_colour_camera_is_turned(bag):
    """The wall's left edge, seen by the turned camera: points of the depth image's left side lean over."""
    depth = read(bag).depth(0, 0)
    edge = (depth > 0).argmax(axis=1)[12:24]
    slope = np.polyfit(np.arange(len(edge)), edge, 1)[0]
    np.testing.assert_allclose(slope, -np.tan(ANGLE), atol=0.05)


def test_depth_has_the_unit_of_the_file_or_the_one_given(bag, tmp_path):
    assert read(bag, depth_unit_m=0.001).depth(0, 0).max() == np.float32(2 * WALL_M)
    assert read(write(tmp_path / "b.bag", drop=("Depth_Units",))).depth(0, 0).max() == np.float32(2 * WALL_M)


@pytest.mark.parametrize(("encoding", "seen"), [("rgb8", (200, 100, 1)), ("bgr8", (1, 100, 200))])
def test_orders_of_colours(tmp_path, encoding, seen):
    sequence = read(write(tmp_path / "a.bag", encoding=encoding))
    assert tuple(sequence.image(1, 0)[5, 7]) == seen


def test_distortion_is_told(tmp_path):
    with pytest.warns(DataWarning, match=r"lens distortion of Color \(Brown Conrady\) is not corrected"):
        read_realsense(write(tmp_path / "a.bag", distortion=[0.1, 0, 0, 0, 0]))


@pytest.mark.parametrize(
    "missing", ["Color_0/image/data", "Depth_0/image/data", "Color_0/info/camera_info", "Depth_0/tf/0"]
)
def test_what_is_missing_is_named(tmp_path, missing):
    bag = write(tmp_path / "a.bag", drop=(missing,))
    says = rf"a.bag: expected the messages {missing} of a RealSense camera, found none; it has /device_0"
    with pytest.raises(DataError, match=says):
        open_sequence(bag)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"encoding": "yuv422"}, "found 'yuv422'. Record colour as RGB8"),
        ({"step": 40}, "48x36 pixels of 3 bytes, found 5184 bytes in lines of 40"),
        ({"step": 4000}, "found 5184 bytes in lines of 4000"),
    ],
)
def test_images_of_other_forms(tmp_path, changes, says):
    bag = write(tmp_path / "a.bag", **changes)
    with pytest.warns(DataWarning, match="left out"), pytest.raises(DataError, match=says):
        open_sequence(bag)


def test_a_size_that_the_file_has_no_pixels_of(tmp_path):
    bag = write(tmp_path / "a.bag", info_size=(2**31, 2**31))
    with (
        pytest.warns(DataWarning, match="left out"),
        pytest.raises(DataError, match=r"Color of 2147483648x2147483648 pixels, .* found 48x36"),
    ):
        open_sequence(bag)


def test_a_rotation_that_is_none(tmp_path):
    with pytest.raises(DataError, match="expected rotations between its cameras"):
        open_sequence(write(tmp_path / "a.bag", turn=0))


@pytest.mark.parametrize("keep", [0.0, 0.001, 0.2, 0.9, 0.999])
def test_files_that_are_cut_off(bag, keep):
    content = bag.read_bytes()
    bag.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(DataError, match=r"desk.bag: expected a recording of a RealSense camera, .* Fetch"):
        open_sequence(bag)
