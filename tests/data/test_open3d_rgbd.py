import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_sequence, read_open3d
from tests.data import dots
from tests.data.scene_helpers import depths_from_another_frame

WIDTH, HEIGHT, NUMBERS = 96, 72, (0, 3, 6, 12)
INTRINSICS = (100.0, 90.0, 50.0, 35.0)
POINT = np.array([0.3, 0.2, 4.0])


def pose(number):
    """The camera moves right by 0.05 per frame and looks along +z, with y down."""
    matrix = np.eye(4)
    matrix[0, 3] = 0.05 * number
    return matrix


def pixel(number):
    fx, fy, cx, cy = INTRINSICS
    return fx * (POINT[0] - 0.05 * number) / POINT[2] + cx, fy * POINT[1] / POINT[2] + cy


def log(poses):
    """A trajectory file as Open3D writes it."""
    blocks = (f"{n} {n} {n + 1}\n" + "\n".join(" ".join(map(str, r)) for r in p) for n, p in poses.items())
    return "\n".join(blocks) + "\n"


class Folder:
    """A recording with images of only some of the frames in its trajectory."""

    def __init__(self, root):
        self.root, self.poses = root, {n: pose(n) for n in range(15)}
        for number in NUMBERS:
            dots.save(root / f"image/{number:05d}.jpg", dots.draw(WIDTH, HEIGHT, [pixel(number)]))
            depth = np.full((HEIGHT, WIDTH), 4000, np.uint16)
            depth[0, :2] = 0, 65535
            dots.save(root / f"depth/{number:05d}.png", depth)
        self.write()

    def write(self, where="test_scene/trajectory.log"):
        (self.root / where).parent.mkdir(exist_ok=True)
        (self.root / where).write_text(log(self.poses))

    def read(self, **options):
        self.write()
        return read_open3d(self.root, INTRINSICS, **options)


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path / "room")


def test_a_point_is_where_it_was_drawn(folder):
    sequence = open_sequence(folder.root, ReadOptions(K=INTRINSICS))
    assert (sequence.name, sequence.frame_ids, sequence.camera_ids) == ("room", NUMBERS, (0,))
    np.testing.assert_allclose(sequence.times, np.array(NUMBERS) / 30)
    for t, number in enumerate(NUMBERS):
        target = dots.project(sequence.Ks[t, 0], sequence.viewmats[t, 0], POINT)
        np.testing.assert_allclose(target, pixel(number))
        assert dots.offset(sequence.image(t, 0), target) < 0.1
    depth = sequence.depth(1, 0)
    assert depth[0, :3].tolist() == [0, 0, 4]
    assert sequence.where("depth", 1, 0).endswith("depth/00003.png")
    assert (
        open_sequence(folder.root, ReadOptions(K=INTRINSICS, depth_unit_m=0.01)).depth(0, 0)[5] == 40
    ).all()


def test_intrinsics_are_a_matrix_or_four_numbers(folder):
    matrix = np.array([[100.0, 0, 50], [0, 90, 35], [0, 0, 1]])
    np.testing.assert_array_equal(folder.read().Ks[0, 0], matrix)
    np.testing.assert_array_equal(read_open3d(folder.root, matrix).Ks[2, 0], matrix)
    with pytest.raises(ValueError, match=r"an Open3D folder has no intrinsics; give K \(--read.K\)"):
        open_sequence(folder.root)
    for bad in (np.nan, -5.0):
        with pytest.raises(ValueError, match=r"K of camera 0 in frame 0 is .*must be finite, with positive"):
            read_open3d(folder.root, (bad, *INTRINSICS[1:]))


def test_poses_that_stand_still_can_be_written_as_the_message_says(folder):
    (folder.root / "test_scene/trajectory.log").unlink()
    with pytest.raises(
        DataError, match=r"expected the camera's poses in trajectory\.log, found colour"
    ) as error:
        open_sequence(folder.root, ReadOptions(K=(50, 50, 32, 24)))
    rows = "\n".join(error.value.args[0].split("the rows ")[1].replace(" and ", ", ").rstrip(".").split(", "))
    numbers = sorted(int(path.stem) for path in (folder.root / "depth").iterdir())
    (folder.root / "trajectory.log").write_text("\n".join(f"{n} {n} {n}\n{rows}" for n in numbers) + "\n")
    sequence = open_sequence(folder.root, ReadOptions(K=(50, 50, 32, 24)))
    np.testing.assert_array_equal(sequence.viewmats, np.broadcast_to(np.eye(4), sequence.viewmats.shape))


@pytest.mark.parametrize("images", ["color", "rgb"])
@pytest.mark.parametrize("where", ["trajectory.log", "scene/trajectory.log", "fragments/trajectory.log"])
def test_places(folder, images, where):
    (folder.root / "image").rename(folder.root / images)
    (folder.root / "test_scene/trajectory.log").unlink()
    folder.write(where)
    assert open_sequence(folder.root, ReadOptions(K=INTRINSICS)).num_frames == 4


def test_another_trajectory(folder):
    folder.poses[3][2, 3] = -1
    folder.write("mine.log")
    folder.poses[3] = pose(3)
    assert folder.read(trajectory="mine.log").viewmats[1, 0, 2, 3] == 1
    for name in ("yours.log", "image"):
        with pytest.raises(DataError, match=f"{name}: expected a trajectory, found no such file"):
            folder.read(trajectory=name)


def test_frames_without_depth_or_pose_are_counted(folder):
    (folder.root / "depth/00003.png").unlink()
    folder.poses[6] = np.full((4, 4), np.nan)
    with pytest.warns(DataWarning, match="room: 2 of 4 frames without depth or a pose are left out"):
        assert folder.read().frame_ids == (0, 12)
    folder.poses = {1: pose(1)}
    with pytest.raises(DataError, match="found 4 images, 3 depths and 1 poses with no number in common"):
        folder.read()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r"blocks of one line of three integers and four lines of four numbers, found 0 numbers"),
        (log({0: pose(0)})[:-5], r"found 18 numbers, not one or more blocks of 19. Is it cut off\?"),
        (log({0: pose(0)}).replace("0.0", "zero", 1), r"found something else \(could not convert .*'zero'"),
        (b"\xff\xfe\x00", r"found binary data \("),
    ],
)
def test_invalid_trajectories_are_refused(folder, text, says):
    file = folder.root / "test_scene/trajectory.log"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=f"trajectory.log: expected .*{says}"):
        read_open3d(folder.root, INTRINSICS)
    file.unlink()
    with pytest.raises(
        DataError, match=r"expected one of trajectory.log, scene/trajectory.log, .*found none"
    ):
        read_open3d(folder.root, INTRINSICS)
    with pytest.raises(DataError, match=r"expected one of the folders image, color, rgb, found none of them"):
        read_open3d(folder.root / "depth", INTRINSICS)


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (np.zeros((4, 4)), "its last row is"),
        (np.diag([0.0, 0, 0, 1]), "R is not a rotation"),
        (np.diag([1.0, 1, -1, 1]), "R is a reflection"),
    ],
)
def test_invalid_poses_are_refused(folder, matrix, says):
    folder.poses[6] = matrix
    with pytest.raises(ValueError, match=f"pose of frame 6 in .*test_scene/trajectory.log: {says}"):
        folder.read()


def test_pictures_of_another_kind(folder):
    dots.save(folder.root / "image/00003.jpg", np.zeros((36, 48, 3), np.uint8))
    dots.save(folder.root / "depth/00006.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    sequence = folder.read()
    with pytest.raises(DataError, match=r"00003.jpg: expected 96x72 pixels, found 48x36"):
        sequence.image(1, 0)
    with pytest.raises(DataError, match=r"00006.png: expected depth as one 16-bit channel, found uint8"):
        sequence.depth(2, 0)
    (folder.root / "image/00000.jpg").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"00000.jpg: expected an image, found something else"):
        folder.read()


def test_the_living_room(shared_data):
    """Points of one frame, moved by the poses, lie on the depth of another."""
    sequence = open_sequence(shared_data / "icl_living_room", ReadOptions(K=(525, 525, 320, 240)))
    assert sequence.frame_ids[:3] == (0, 3, 6)
    measured, expected = depths_from_another_frame(sequence, 0, 10)
    assert np.median(np.abs(measured - expected)) < 0.01
