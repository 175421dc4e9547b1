import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.data.alignment import align_cameras

RANDOM = np.random.default_rng(3)
TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def cameras(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=RANDOM).as_matrix()
    poses[:, :3, 3] = RANDOM.normal(size=(count, 3))
    return poses


def seen_elsewhere(to_world, scale, turn, shift):
    """The same cameras in a world whose points are scale * turn @ point + shift."""
    moved = to_world.copy()
    moved[:, :3, :3] = turn @ to_world[:, :3, :3]
    moved[:, :3, 3] = scale * to_world[:, :3, 3] @ turn.T + shift
    return moved


def test_a_similarity_is_found_and_nothing_is_left():
    poses = cameras(9)
    there = seen_elsewhere(poses, 2.5, TURN, [3.0, -4, 5])
    found = align_cameras(np.linalg.inv(poses), np.linalg.inv(there))
    assert found.scale == pytest.approx(2.5)
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(found.translation, [3, -4, 5], atol=1e-12)
    assert max(found.turned_deg.max(), found.moved.max()) < 1e-6
    centers = there[:, :3, 3]
    assert found.extent == pytest.approx(max(np.linalg.norm(a - b) for a in centers for b in centers))


def test_one_camera_that_is_turned_and_one_that_is_moved():
    poses = cameras(40)
    there = seen_elsewhere(poses, 0.5, TURN, [1.0, 0, 0])
    there[3, :3, :3] = there[3, :3, :3] @ Rotation.from_rotvec([0, np.radians(7), 0]).as_matrix()
    there[8, :3, 3] += [0, 0, 0.02]
    found = align_cameras(np.linalg.inv(poses), np.linalg.inv(there))
    assert found.turned_deg[3] == pytest.approx(7, abs=0.1)
    assert np.delete(found.turned_deg, 3).max() < 0.1
    assert found.moved[8] == pytest.approx(0.02, abs=0.002)
    assert np.delete(found.moved, 8).max() < 0.003


def test_cameras_in_a_plane_are_not_mirrored():
    poses = cameras(6)
    poses[:, 2, 3] = 0
    found = align_cameras(np.linalg.inv(poses), np.linalg.inv(seen_elsewhere(poses, 1.0, TURN, [0, 0, 0])))
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)


def test_cameras_that_leave_the_rotation_ambiguous_are_refused():
    poses = cameras(4)
    line = poses.copy()
    line[:, :3, 3] = np.arange(4)[:, None] * [1.0, 2, 3]
    with pytest.raises(ValueError, match="the cameras are collinear"):
        align_cameras(np.linalg.inv(line), np.linalg.inv(line))
    with pytest.raises(
        ValueError, match=r"expected the same number of cameras, three or more, found 2 and 2"
    ):
        align_cameras(poses[:2], poses[:2])
