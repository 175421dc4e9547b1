"""Recordings written message by message as librealsense writes them."""

import cv2
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_photographs, open_sequence, read_realsense
from tests.data import dots
from tests.data.sensors import COLOR, DEPTH, UNIT, realsense, scene

pytest.importorskip("rosbags", reason="the extra `rosbag` is not installed")

SCENE = scene(32, 24)


@pytest.fixture
def messages():
    return realsense()


@pytest.fixture
def write(tmp_path):
    return lambda messages: messages.write(tmp_path / "desk.bag")


@pytest.mark.thorough
@pytest.mark.parametrize("marked", [True, False])
@pytest.mark.parametrize("compressed", [True, False])
def test_a_recording_is_read_as_it_was(tmp_path, marked, compressed):
    path = realsense(unit=0.0005, marked=marked).write(tmp_path / "desk.bag", compressed)
    sequence = open_sequence(path)
    assert (sequence.name, sequence.frame_ids, sequence.width, sequence.height) == ("desk", (0, 1, 2), 32, 24)
    np.testing.assert_allclose(np.diff(sequence.times), 0.033, atol=1e-6)
    np.testing.assert_allclose(sequence.Ks[1, 0], SCENE.Ks[0, 0])
    np.testing.assert_array_equal(sequence.viewmats[2, 0], np.eye(4))
    for t in (2, 0, 1):
        np.testing.assert_array_equal(sequence.image(t, 0), SCENE.image(t, 0))
        np.testing.assert_allclose(sequence.depth(t, 0), SCENE.depth(t, 0), atol=0.0003)
    assert sequence.where("depth", 1, 0).endswith("desk.bag, image 1 of /device_0/sensor_0/Depth_0")
    assert open_photographs(path).num == 3
    doubled = open_sequence(path, ReadOptions(depth_unit_m=0.001)).depth(0, 0)
    np.testing.assert_allclose(doubled, 2 * SCENE.depth(0, 0), atol=0.0006)


def test_depth_moves_to_the_colour_camera(messages, write):
    """A box 1 m away in front of a wall at 2 m. The colour camera is 0.0625 m to the side and has twice the
    resolution: in it, the box shifts to the left by 4 of its pixels and the wall by 2."""
    depth = np.full((24, 32), 2000, np.uint16)
    depth[8:16, 8:16] = 1000
    depth[0, 0], depth[0, 31] = 0, 65535
    messages.images(DEPTH, "mono16", [(0.03, depth)], unit=0.001)
    messages.images(COLOR, "rgb8", [(0.03, np.zeros((48, 64, 3), np.uint8))], unit=0)
    messages.info(DEPTH, [[32, 0, 16], [0, 32, 12], [0, 0, 1]])
    messages.info(COLOR, [[64, 0, 32], [0, 64, 24], [0, 0, 1]], size=(64, 48))
    messages.place(COLOR, (-0.0625, 0.0, 0.0))
    expected = np.zeros((48, 64), np.float32)
    expected[:, :62] = 2.0
    expected[:2, 60:] = 0  # the invalid last pixel of the first row, and the strip newly in view beside it
    expected[16:32, 28:30] = 0  # hidden from the depth camera
    expected[16:32, 12:28] = 1.0
    np.testing.assert_array_equal(read_realsense(write(messages)).depth(0, 0), expected)


def test_a_turned_colour_camera(messages, write):
    """Rotated by 90 degrees about its viewing direction, it sees at the top what was on the right."""
    depth = np.full((24, 24), 1000, np.uint16)
    depth[:, 20:] = 500
    messages.images(DEPTH, "mono16", [(0.03, depth)], unit=0.001)
    messages.images(COLOR, "rgb8", [(0.03, np.zeros((24, 24, 3), np.uint8))], unit=0)
    for name in (COLOR, DEPTH):
        messages.info(name, [[24, 0, 12], [0, 24, 12], [0, 0, 1]], size=(24, 24))
    messages.place(COLOR, quat=(0.0, 0.0, -(0.5**0.5), 0.5**0.5))
    seen = read_realsense(write(messages)).depth(0, 0)
    np.testing.assert_array_equal(seen[:4], 0.5)
    np.testing.assert_array_equal(seen[4:], 1.0)


def test_the_lens_is_made_a_pinhole(messages, write):
    K, coeffs = np.array([[100.0, 0, 48], [0, 100, 36], [0, 0, 1]]), (0.2, -0.05, 0.001, -0.002, 0.01)
    point = np.array([0.3, 0.2, 1.0])
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    (((x, y),),), _ = cv2.projectPoints(point[None], np.zeros(3), np.zeros(3), K - half, np.array(coeffs))
    messages.images(COLOR, "rgb8", [(0.03, dots.draw(96, 72, [(x + 0.5, y + 0.5)]))], unit=0)
    messages.info(COLOR, K, coeffs=coeffs, size=(96, 72))
    sequence = read_realsense(write(messages))
    assert dots.offset(sequence.image(0, 0), dots.project(sequence.Ks[0, 0], np.eye(4), point)) < 0.1
    assert np.hypot(x + 0.5 - 78, y + 0.5 - 56) > 0.5  # where a pinhole of the same K sees it


@pytest.mark.parametrize(
    ("encoding", "pixel"),
    [
        ("rgb8", [200, 100, 50]),
        ("bgr8", [50, 100, 200]),
        ("rgba8", [200, 100, 50, 0]),
        ("bgra8", [50, 100, 200, 9]),
        ("YUYV", [123, 91, 123, 175]),
        ("yuv422", [91, 123, 175, 123]),
    ],
)
def test_encodings_of_colour(messages, write, encoding, pixel):
    pixels = np.tile(np.array(pixel, np.uint8), (24, 32 if encoding[-1] == "8" else 16, 1))
    pixels = pixels if encoding[-1] == "8" else pixels.reshape(24, 32, 2)
    messages.images(COLOR, encoding, [(0.03, pixels)], unit=0)
    found = read_realsense(write(messages)).load_image(0, 0)
    np.testing.assert_allclose(found, np.broadcast_to([200, 100, 50], (24, 32, 3)), atol=2)


def test_numbers_that_begin_with_their_high_byte(messages, write):
    depth = np.full((24, 32), 1500, ">u2")
    messages.images(DEPTH, "mono16", [(0.03, depth)], unit=0.001, big_endian=True)
    with pytest.warns(DataWarning, match="2 of 3 frames are left out"):
        sequence = read_realsense(write(messages))
    np.testing.assert_allclose(sequence.depth(0, 0), 1.5, rtol=1e-6)


def test_colour_is_paired_with_the_depth_nearest_in_time(messages, write):
    kind, (first, _, third) = messages.topics[f"{DEPTH}/image/data"]
    messages.topics[f"{DEPTH}/image/data"] = kind, [first, third, (third[0] + 0.001, third[1])]
    path = write(messages)
    with pytest.warns(DataWarning) as caught:
        sequence = read_realsense(path)
    said = " ".join(str(warning.message) for warning in caught)
    assert "1 of 3 images of /device_0/sensor_0/Depth_0 repeat a time and are left out" in said
    assert "desk.bag: 1 of 3 frames are left out: 1 without depth" in said
    assert sequence.frame_ids == (0, 2)
    np.testing.assert_allclose(sequence.depth(1, 0), SCENE.depth(2, 0), atol=0.0006)


def test_a_unit_that_is_not_recorded_is_assumed(write):
    messages = realsense(marked=False)
    del messages.topics[UNIT]
    path = write(messages)
    with pytest.warns(DataWarning, match=r"desk.bag: no depth unit; assuming 0.001 m; give depth_unit_m"):
        np.testing.assert_allclose(read_realsense(path).depth(0, 0), SCENE.depth(0, 0), atol=0.0006)


def without(topic):
    return lambda messages: messages.topics.pop(topic)


def encoded(name, encoding, pixel=(1, 2)):
    return lambda m: m.images(name, encoding, [(0.03, np.tile(np.uint8(pixel), (24, 32, 1)))], unit=0.001)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (
            without(f"{COLOR}/image/data"),
            "expected colour of a RealSense camera, .*N/Color_0/image/data, found /device_0",
        ),
        (without(f"{DEPTH}/image/data"), "expected depth of a RealSense camera, .* found /device_0"),
        (
            without(f"{DEPTH}/info/camera_info"),
            "expected intrinsics in .*Depth_0/info/camera_info, found none",
        ),
        (without(f"{COLOR}/tf/0"), "expected the place of a camera in .*Color_0/tf/0, found none"),
        (lambda m: m.info(COLOR, np.diag([0, 0, 1])), r"expected focal lengths above 0 in .*, found K \[0"),
        (lambda m: m.info(COLOR, SCENE.Ks[0, 0], "Ftheta", (1.0,) * 5), "found Ftheta, 5 coefficients"),
        (lambda m: m.info(COLOR, SCENE.Ks[0, 0], coeffs=(1.0,) * 3), "Brown Conrady, 3 coefficients"),
        (
            lambda m: m.info(COLOR, SCENE.Ks[0, 0], size=(10**5, 10**5)),
            "expected 100000x100000 pixels of rgb8",
        ),
        (
            lambda m: m.place(DEPTH, quat=(0.0, 0.0, 0.0, 0.0)),
            "Depth_0/tf/0: expected a quaternion of length 1, found one of length 0",
        ),
        (encoded(COLOR, "MJPEG"), "Color_0: expected one of rgb8, bgr8.*, found MJPEG"),
        (encoded(COLOR, "rgb8"), "expected 32x24 pixels of rgb8, found 32x24 in 1536 bytes"),
        (encoded(DEPTH, "8UC1"), "Depth_0: expected one of mono16, .*, found 8UC1"),
    ],
)
def test_what_is_missing_or_not_read_is_named(messages, write, damage, says):
    for name in (COLOR, DEPTH):  # one frame
        kind, found = messages.topics[f"{name}/image/data"]
        messages.topics[f"{name}/image/data"] = kind, found[:1]
    damage(messages)
    path = write(messages)
    with pytest.raises(DataError, match=f"desk.bag.*{says}"):
        read_realsense(path)


@pytest.mark.thorough
def test_damaged_files_are_refused(messages, write):
    path = write(messages)
    content = path.read_bytes()
    for damaged in (
        b"",
        content[:2000],
        content[: len(content) // 2],
        content[:-20],
        content.replace(b"lz4", b"lzo"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=r"desk.bag: expected a rosbag, found bad data \(.*reindex"):
            open_sequence(path)
    with pytest.raises(DataError, match=r"none.bag: expected a rosbag, found no such file"):
        read_realsense(path.with_name("none.bag"))
