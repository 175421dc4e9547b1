"""Cameras: projection and its inverse, and conventions of axes and pixels."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsjax.geometry.cameras import (
    Camera,
    camera_centers,
    intrinsics,
    look_at,
    perturbed,
    pixel_grid,
    pixels_of,
    project,
    unproject,
    viewmat_from_opengl,
    world_to_camera,
)

EYE, TARGET = np.array([2.0, -1.0, 1.5]), np.array([0.1, 0.2, 0.3])
SKEWED = jnp.array([[50.0, 1.5, 30.0], [0.0, 55.0, 22.0], [0.0, 0.0, 1.0]])


@pytest.mark.usefixtures("x64")
def test_unproject_inverts_project_also_with_skew():
    points = jnp.asarray(np.random.default_rng(0).normal(size=(4, 5, 3)) * 0.5)
    viewmat = jnp.asarray(look_at(EYE, TARGET))
    K = jnp.asarray(SKEWED, jnp.float64)
    pixels, depths = project(points, viewmat, K)
    assert (pixels.shape, depths.shape) == ((4, 5, 2), (4, 5))
    np.testing.assert_allclose(unproject(pixels, depths, viewmat, K), points, atol=1e-12)


def test_project_is_finite_behind_the_camera():
    pixels, depths = project(jnp.array([[0.0, 0.0, -1.0], [1.0, 1.0, 0.0]]), jnp.eye(4), SKEWED)
    assert np.isfinite(pixels).all()
    np.testing.assert_array_equal(depths, [-1.0, 0.0])


@pytest.mark.usefixtures("x64")
def test_the_pixels_of_points_are_where_they_project():
    K, viewmat = np.asarray(SKEWED, np.float64), look_at(EYE, TARGET)
    points = np.random.default_rng(1).normal(size=(2000, 3)) * 2  # some behind the camera, some outside
    columns, rows, depths, inside = pixels_of(points, viewmat, K, 60, 44)
    pixels, z = map(np.asarray, project(*(jnp.asarray(a) for a in (points, viewmat, K))))
    shown = (z > 0) & (pixels >= 0).all(1) & (pixels < [60, 44]).all(1)
    assert 100 < shown.sum() < len(points) - 100
    np.testing.assert_array_equal(inside, shown)
    np.testing.assert_allclose(depths, z, atol=1e-12)
    np.testing.assert_array_equal(np.stack([columns, rows], 1), np.where(shown[:, None], pixels // 1, 0))


def test_a_picture_holds_its_left_and_upper_edge_and_not_the_others():
    K = intrinsics(1.0, 2, 2)
    corners = np.array([[-1, -1, 1.0], [1, -1, 1], [-1, 1, 1], [0.999, 0.999, 1], [0, 0, 0], [0, 0, -1]])
    found = pixels_of(corners, np.eye(4), K, 2, 2)
    np.testing.assert_array_equal(found.inside, [True, False, False, True, False, False])
    np.testing.assert_array_equal(found.columns, [0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(found.rows, [0, 0, 0, 1, 0, 0])


def test_look_at_sees_its_target_in_the_middle_with_up_above():
    viewmat = look_at(EYE, TARGET)
    np.testing.assert_allclose(viewmat[:3, :3] @ viewmat[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(viewmat[:3, :3]) == pytest.approx(1.0)
    local = viewmat[:3, :3] @ TARGET + viewmat[:3, 3]
    np.testing.assert_allclose(local, [0, 0, np.linalg.norm(TARGET - EYE)], atol=1e-12)
    above = viewmat[:3, :3] @ (TARGET + np.array([0, 0, 0.1])) + viewmat[:3, 3]
    assert above[1] < 0  # +y is down
    np.testing.assert_allclose(camera_centers(jnp.asarray(viewmat)), EYE, atol=1e-6)


@pytest.mark.usefixtures("x64")
def test_perturbed_cameras_are_rotated_about_their_own_centres_and_shifted():
    viewmats = jnp.stack([jnp.asarray(look_at(EYE, TARGET)), jnp.asarray(look_at(-EYE, TARGET))])
    twist = jnp.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.2])
    found = perturbed(viewmats, twist, 2.0)
    shifts = camera_centers(found) - camera_centers(viewmats)
    np.testing.assert_allclose(shifts, [2.0 * twist[3:]] * 2, atol=1e-12)
    turn = Rotation.from_rotvec(np.array(twist[:3])).as_matrix()
    np.testing.assert_allclose(found[:, :3, :3], viewmats[:, :3, :3] @ turn.T, atol=1e-12)


def test_no_product_of_perturbed_cameras_is_in_reduced_precision():
    program = jax.jit(perturbed).lower(jnp.eye(4)[None], jnp.ones(6), 2.0).as_text()
    assert "HIGHEST" in program
    assert not re.search(r"contracting_dims = \[\d.*DEFAULT", program)


@pytest.mark.thorough
@pytest.mark.usefixtures("x64")
def test_derivatives_of_perturbed_cameras_are_those_of_finite_differences():
    viewmat, K = jnp.asarray(look_at(EYE, TARGET))[None], jnp.asarray(SKEWED, jnp.float64)
    random = np.random.default_rng(1)
    points = jnp.asarray(random.uniform(-0.02, 0.02, (20, 3)))
    weights = jnp.asarray(random.normal(size=(20, 3)))

    def of(twist):
        pixels, depths = project(points, perturbed(viewmat, twist, 0.03)[0], K)
        return jnp.sum(weights * jnp.concatenate([pixels, depths[:, None]], axis=1))

    for twist in (jnp.zeros(6), jnp.asarray(random.normal(size=6) * 0.1)):
        slopes = jax.grad(of)(twist)
        steps = 1e-6 * np.eye(6)
        measured = [(of(twist + step) - of(twist - step)) / 2e-6 for step in steps]
        np.testing.assert_allclose(slopes, np.array(measured), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("eye", "target"), [(EYE, EYE), (np.zeros(3), np.array([0.0, 0.0, 2.0]))])
def test_look_at_refuses_what_has_no_direction(eye, target):
    with pytest.raises(ValueError, match="no direction apart from up"):
        look_at(eye, target)


def test_opengl_poses_become_opencv_views():
    # Blender's camera at rest: at (0, 0, 3), looking along -z with +y up.
    pose = np.eye(4)
    pose[2, 3] = 3.0
    viewmat = viewmat_from_opengl(pose)
    origin, above = viewmat @ [0, 0, 0, 1], viewmat @ [0, 1, 0, 1]
    np.testing.assert_allclose(origin[:3], [0, 0, 3], atol=1e-12)
    np.testing.assert_allclose(above[:3], [0, -1, 3], atol=1e-12)
    poses = np.stack([pose, np.linalg.inv(look_at(EYE, TARGET)) @ np.diag([1.0, -1, -1, 1])])
    np.testing.assert_allclose(viewmat_from_opengl(poses)[1], look_at(EYE, TARGET), atol=1e-12)


def test_the_middle_of_the_image_is_the_principal_point_and_centres_stand_at_half():
    K = intrinsics(40.0, 10, 6)
    np.testing.assert_array_equal(K[:2, 2], [5.0, 3.0])
    np.testing.assert_array_equal(intrinsics(40.0, 10, 6, (1.0, 2.0))[:2, 2], [1.0, 2.0])
    grid = pixel_grid(10, 6)
    assert grid.shape == (6, 10, 2)
    np.testing.assert_array_equal(grid[2, 7], [7.5, 2.5])


def test_a_camera_holds_many_of_one_size():
    camera = Camera(jnp.eye(4)[None], jnp.asarray(SKEWED)[None], width=60, height=44)
    np.testing.assert_allclose(world_to_camera(jnp.ones((2, 3)), camera.viewmat[0]), 1.0)
    assert (camera.width, camera.height) == (60, 44)
