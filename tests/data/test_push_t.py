import json
import shutil

import cv2
import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, read_push_t
from gsjax.data.push_t import MAX_SKEW_S
from gsjax.data.video import Video

WIDTH, HEIGHT = 64, 48
K = [[40.0, 0.0, 31.5], [0.0, 40.0, 23.5], [0.0, 0.0, 1.0]]


def write_video(path, count):
    """Frame i has grey level 10 + 8 i in its left half, 128 in its right."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 90, (WIDTH, HEIGHT))
    for i in range(count):
        image = np.full((HEIGHT, WIDTH, 3), 10 + 8 * i, np.uint8)
        image[:, WIDTH // 2 :] = 128
        writer.write(image)
    writer.release()


def level(image):
    """The frame number encoded in an image."""
    return round((float(image[:, : WIDTH // 4].mean()) - 10) / 8)


class Folder:
    def __init__(self, root, stamps):
        self.root, self.demo = root, root / "sample_demos" / "0"
        (self.demo / "videos").mkdir(parents=True)
        self.cameras = {}
        for serial, times in stamps.items():
            self.cameras[serial] = {"X_WC": np.eye(4).tolist()}
            self.write_record(serial, times)
            write_video(self.demo / "videos" / f"{serial}.mp4", len(times))
        self.write_cameras()

    def write_cameras(self):
        (self.demo / "cameras.json").write_text(json.dumps(self.cameras))

    def write_record(self, serial, times, **changes):
        record = {"serial": serial, "K": K, "resolution": [WIDTH, HEIGHT], "timestamps": list(times)}
        (self.demo / "videos" / f"{serial}.json").write_text(json.dumps(record | changes))


@pytest.fixture
def folder(tmp_path):
    """Camera b lacks its second image and is 5 ms late."""
    times = np.arange(20) * 0.02
    return Folder(tmp_path / "push", {"a": times, "b": np.delete(times, 1) + 0.005})


def test_cameras_are_paired_by_time(folder):
    sequence = read_push_t(folder.root)
    assert sequence.num_frames == 20
    assert sequence.camera_ids == (0, 1)
    np.testing.assert_allclose(sequence.times, np.arange(20) * 0.02)
    assert [level(sequence.image(t, 0)) for t in range(20)] == list(range(20))
    assert [level(sequence.image(t, 1)) for t in range(20)] == [0, 0, *range(1, 19)]
    assert not sequence.has_depth
    assert sequence.models == ()


def test_any_frame_may_be_read_in_any_order(folder):
    sequence = read_push_t(folder.root)
    order = [5, 6, 2, 19, 0, 18, 17, 3, 4]
    assert [level(sequence.image(t, 0)) for t in order] == order


def test_conventions_are_those_of_the_package(folder):
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    folder.cameras["a"]["X_WC"] = pose.tolist()
    folder.write_cameras()
    sequence = read_push_t(folder.root)
    np.testing.assert_allclose(sequence.Ks[0, 0], [[40, 0, 32], [0, 40, 24], [0, 0, 1]])
    # An OpenGL camera looks along -z: what lies 1 m below it (in z) is 1 m ahead.
    ahead = sequence.viewmats[0, 0] @ [1, 2, 2, 1]
    np.testing.assert_allclose(ahead, [0, 0, 1, 1], atol=1e-12)
    np.testing.assert_allclose(sequence.viewmats[0, 0] @ [1, 3, 2, 1], [0, -1, 1, 1], atol=1e-12)


def test_frames_of_which_a_camera_is_too_late_are_counted_and_left_out(folder):
    times = np.arange(20) * 0.02
    late = np.where(np.arange(19) < 5, times[1:], times[1:] + 0.4 + MAX_SKEW_S)  # a gap after the fifth
    folder.write_record("b", late)
    with pytest.warns(DataWarning, match=r"13 of 20 frames are left out: 13 without b.mp4 .* within 30 ms"):
        sequence = read_push_t(folder.root)
    assert sequence.frame_ids == tuple(range(7))
    np.testing.assert_allclose(sequence.times, times[:7])
    assert [level(sequence.image(t, 1)) for t in range(7)] == [0, 0, 1, 2, 3, 4, 4]
    assert sequence.Ks.shape == (7, 2, 3, 3)
    with pytest.warns(DataWarning, match=r"15 of 20 frames are left out.* within 15 ms"):
        assert read_push_t(folder.root, max_skew=0.015).frame_ids == (1, 2, 3, 4, 5)


def test_cameras_that_never_meet(folder):
    folder.write_record("b", np.delete(np.arange(20) * 0.02, 1) + 10)
    with pytest.raises(
        DataError, match=r"videos: .* within 30 ms, found none: .* the nearest b.mp4 is 10 s away"
    ):
        read_push_t(folder.root)


def test_missing_and_disagreeing_files(folder, tmp_path):
    with pytest.raises(DataError, match=r"cameras.json: .*no such file"):
        read_push_t(tmp_path)
    with pytest.raises(DataError, match=r"sample_demos/3/cameras.json"):
        read_push_t(folder.root, demo=3)
    folder.write_record("b", np.arange(18) * 0.02 + 0.02)
    with pytest.raises(DataError, match=r"b.mp4: expected 18 frames, one per timestamp, found 19"):
        read_push_t(folder.root).image(0, 1)
    folder.write_record("b", np.arange(20) * 0.02, resolution=[32, 48])
    with pytest.raises(DataError, match=r"b.json: expected 64x48 .*found 32x48"):
        read_push_t(folder.root)
    (folder.demo / "videos/b.mp4").unlink()
    with pytest.raises(DataError, match=r"b.mp4: expected a video, found no such file"):
        read_push_t(folder.root)
    (folder.demo / "videos/b.json").write_text(json.dumps({"K": K}))
    with pytest.raises(DataError, match=r"b.json: expected the key 'timestamps'"):
        read_push_t(folder.root)


def test_a_file_that_is_no_video(folder):
    (folder.demo / "videos/a.mp4").write_text("no video")
    with pytest.raises(DataError, match=r"a.mp4: expected a video, found a file that does not open"):
        read_push_t(folder.root).image(0, 0)


def test_a_video_of_another_size_or_length(folder):
    path = folder.demo / "videos/a.mp4"
    with pytest.raises(DataError, match=r"a.mp4: expected 32x24 pixels, found 64x48"):
        Video(path, 32, 24, 20).frame(0)
    video = Video(path, WIDTH, HEIGHT, 20)
    with pytest.raises(DataError, match=r"a.mp4: expected 20 frames, found no frame 25"):
        video.frame(25)
    assert level(video.frame(3)) == 3  # reading continues after an error


def test_recordings_without_cameras_or_timestamps(folder):
    folder.write_record("b", [])
    with pytest.raises(DataError, match=r"expected times of b.mp4, found none"):
        read_push_t(folder.root)
    folder.cameras = {}
    folder.write_cameras()
    with pytest.raises(DataError, match=r"cameras.json: expected at least one camera"):
        read_push_t(folder.root)


@pytest.mark.parametrize(("camera", "count"), [("a", 20), ("b", 19)])
def test_timestamps_that_go_back(folder, camera, count):
    folder.write_record(camera, [0.0, 0.02, 0.01, *np.arange(3, count) * 0.02])
    with pytest.raises(DataError, match=rf"times of {camera}.mp4 that increase, found frame 2 is at 0.01 s"):
        read_push_t(folder.root)


def test_known_shapes(folder):
    environment, objects = folder.root / "environment", folder.root / "objects"
    environment.mkdir()
    objects.mkdir()
    x, y = np.meshgrid(np.arange(10) * 0.1, np.arange(10) * 0.1)
    np.save(environment / "ground.npy", np.stack([x, y, x], -1).reshape(-1, 3))
    plane = [-np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]
    (environment / "ground_plane.json").write_text(json.dumps({"plane": plane}))
    block = {
        "means": np.zeros((2, 3)),
        "quats": np.eye(4)[:2],
        "scales": np.ones((2, 3)),
        "opacities": np.ones(2),
    }
    block = {name: value.tolist() for name, value in block.items()} | {
        "colors": [[0.2, 0.4, 0.9], [0.1, 0.3, 0.8]]
    }
    (objects / "tblock.json").write_text(json.dumps({"gaussians": block}))
    ground, tblock = read_push_t(folder.root).models
    assert (ground.label, tblock.label) == (0, 1)
    assert tblock.pose is None
    np.testing.assert_allclose(tblock.colors[0], [0.9, 0.4, 0.2])  # the file's order is blue, green, red
    np.testing.assert_allclose(tblock.plane, plane)
    w, a, b, c = ground.quats[0]
    normal = [2 * (a * c + w * b), 2 * (b * c - w * a), 1 - 2 * (a * a + b * b)]
    np.testing.assert_allclose(normal, plane[:3], atol=1e-6)
    assert (ground.scales[:, 2] < ground.scales[:, 0]).all()
    np.testing.assert_allclose(ground.means @ plane[:3] + plane[3], 0, atol=1e-12)


@pytest.fixture(scope="module")
def recording(shared_data):
    return read_push_t(shared_data / "push_t")


def test_the_recording(recording):
    assert recording.num_frames == 803
    assert recording.num_cameras == 3
    assert recording.times[-1] - recording.times[0] == pytest.approx(14.7, abs=0.1)
    assert recording.image(0, 2).shape == (270, 480, 3)


@pytest.mark.thorough
def test_seeking_finds_the_same_images_as_reading_on(recording, shared_data):
    in_order = [recording.image(t, 0) for t in range(395, 402)]
    fresh = read_push_t(shared_data / "push_t")
    for t in (401, 397, 395):
        np.testing.assert_array_equal(fresh.image(t, 0), in_order[t - 395])


def test_the_ground_lies_in_its_plane_and_the_block_has_the_colour_of_the_video(recording):
    ground, block = recording.models
    assert np.abs(ground.means @ ground.plane[:3] + ground.plane[3]).max() < 1e-6
    image = recording.image(300, 0)
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(int)
    orange = ((hsv[..., 0] < 14) | (hsv[..., 0] > 174)) & (hsv[..., 1] > 140) & (hsv[..., 2] > 120)
    seen, modelled = image[orange].mean(0) / 255, block.colors.mean(0)
    assert orange.sum() > 500
    assert np.argsort(seen).tolist() == np.argsort(modelled).tolist()
    assert np.abs(seen - modelled).max() < np.abs(seen - modelled[::-1]).max()


def test_a_folder_without_models_is_enough(recording, shared_data, tmp_path):
    shutil.copytree(shared_data / "push_t" / "sample_demos", tmp_path / "sample_demos")
    sequence = read_push_t(tmp_path)
    assert sequence.models == ()
    np.testing.assert_array_equal(sequence.image(3, 1), recording.image(3, 1))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"K": [[40.0, 0.0], [0.0]]}, "expected K as 3x3 numbers"),
        ({"timestamps": [0.0, [1.0]]}, "expected timestamps as N numbers"),
        ({"resolution": [64]}, "expected resolution as 2 numbers"),
        ({"resolution": [64, 0]}, "expected a width and a height above 0"),
        ({"K": [[40.0, 0.0, 31.5], [0.0, 40.0, 23.5], [0.0, 0.0, 9.0]]}, "K of camera 1 in frame 0"),
    ],
)
def test_records_with_other_numbers(folder, changes, says):
    folder.write_record("b", np.delete(np.arange(20) * 0.02, 1), **changes)
    with pytest.raises(ValueError, match=says) as refused:
        read_push_t(folder.root)
    assert str(folder.root) in str(refused.value)
