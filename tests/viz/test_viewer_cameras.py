"""The viewer's cameras: the up direction, the initial pose, and what the browser's camera sees."""

import numpy as np
import pytest

from gsjax.geometry.cameras import look_at
from gsjax.viz.viewer import Viewable
from gsjax.viz.viewer.cameras import (
    browser_camera,
    extent,
    far_plane,
    first_pose,
    picture_size,
    pose_of,
    scene_up,
    up_direction,
    vertical_fov,
)
from gsjax.viz.viewer.splats import depth_range
from tests.viz.scenes import cloud, made, shots_around


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [0.6, 0, 0.8]])
def test_up_is_where_level_cameras_say(up):
    found = up_direction(shots_around(up, height=1.5).viewmats[0])
    np.testing.assert_allclose(found, up, atol=1e-6)


def test_cameras_that_look_one_way_say_up_by_their_pictures():
    viewmats = np.stack([look_at(np.array([x, 0.1, 2.0]), np.array([x, 0.0, 0])) for x in (-0.1, 0, 0.1)])
    up = up_direction(viewmats)
    assert up @ -viewmats[0, 1, :3] > 0.97


def test_a_scene_says_what_is_up():
    assert scene_up(Viewable("x", cloud())).tolist() == [0, 0, 1]
    assert scene_up(Viewable("x", cloud(), up=np.array([0, -2.0, 0]))).tolist() == [0, -1, 0]


def test_the_first_pose_is_that_of_a_photograph():
    rng = np.random.default_rng(0)
    ball = made(
        rng.normal(0, 0.2, (300, 3)), rng.normal(size=(300, 4)), np.full((300, 3), 0.1), [0.9] * 300,
        np.zeros((300, 3)),
    )  # fmt: skip
    scene = Viewable("x", ball, shots=shots_around([0, 0, 1]))
    pose = first_pose(scene)
    to_world = np.linalg.inv(scene.shots.viewmats[0, 0])
    np.testing.assert_allclose(pose.position, to_world[:3, 3], atol=1e-9)
    assert np.linalg.norm(pose.target) < 0.6  # the ball's near side, not the camera
    assert pose.up.tolist() == [0, 0, 1]
    assert pose.fov == pytest.approx(2 * np.arctan(0.5))
    assert far_plane(ball, pose) == 1000


def test_without_photographs_it_is_seen_whole():
    gaussians = cloud(200)
    pose = first_pose(Viewable("x", gaussians, up=np.array([0, -1.0, 0])))
    middle, _ = extent(gaussians)
    np.testing.assert_allclose(pose.target, middle)
    view = look_at(pose.position, pose.target, pose.up)
    local = np.asarray(gaussians.means) @ view[:3, :3].T + view[:3, 3]
    inside = np.abs(local[:, :2]).max(1) < np.tan(pose.fov / 2) * local[:, 2]
    assert inside.mean() > 0.75
    assert pose.position @ [0, -1, 0] > middle @ [0, -1, 0]


def test_the_browsers_camera_sees_what_the_photographs_saw():
    shots = shots_around([0, 0, 1])
    from scipy.spatial.transform import Rotation

    pose = pose_of(shots, 0, 2, 3.0)
    wxyz = Rotation.from_matrix(shots.viewmats[0, 2, :3, :3].T).as_quat(scalar_first=True)
    camera = browser_camera(wxyz, pose.position, pose.fov, 640, 480)
    np.testing.assert_allclose(camera.viewmat[0], shots.viewmats[0, 2], atol=1e-6)
    np.testing.assert_allclose(camera.K[0], shots.Ks[0, 2], atol=1e-3)
    np.testing.assert_allclose(pose.target, pose.position + 3 * shots.viewmats[0, 2, 2, :3])
    assert vertical_fov(shots.Ks[0, 2], 480) == pytest.approx(pose.fov)


def test_pictures_have_about_the_windows_shape():
    assert picture_size(320, (1600, 920)) == (320, 184)
    assert picture_size(320, (1601, 925)) == (320, 184)
    assert picture_size(160, (0, 0)) == (160, 160)
    assert picture_size(160, (100, 5000)) == (160, 480)
    assert picture_size(160, (5000, 10)) == (160, 8)


def test_the_depth_scale_covers_what_is_seen():
    means = np.array([[0, 0, 1.0], [0, 0, 2], [0, 0, 3], [50, 0, 4], [0, 0, -5]])
    near, far = depth_range(means, np.eye(4), 1.0, 1.0)
    assert (near, far) == pytest.approx((1.04, 2.96))
    assert depth_range(-means[:3], np.eye(4), 1.0, 1.0) is None
