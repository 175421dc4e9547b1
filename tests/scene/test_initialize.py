"""Initial scenes: points from depth, and the sizes and normals of their Gaussians."""

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at, project
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.initialize import (
    estimate_normals,
    gaussians_from_points,
    points_from_rgbd,
    quats_from_normals,
    spacing_scales,
)

WIDTH, HEIGHT = 32, 24
K = intrinsics(40.0, WIDTH, HEIGHT)
VIEWMAT = look_at(np.array([0.3, -0.5, 1.0]), np.zeros(3))


def picture(seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (HEIGHT, WIDTH, 3)), rng.uniform(0.5, 2.0, (HEIGHT, WIDTH))


@pytest.mark.parametrize("stride", [1, 2, 5])
def test_points_project_back_to_the_centres_of_their_pixels(stride):
    image, depth = picture()
    points, colors = points_from_rgbd(image, depth, VIEWMAT, K, stride=stride)
    rows, columns = np.mgrid[0:HEIGHT:stride, 0:WIDTH:stride].reshape(2, -1)
    pixels, z = project(jnp.asarray(points), jnp.asarray(VIEWMAT, jnp.float32), jnp.asarray(K, jnp.float32))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], 1) + 0.5, atol=1e-3)
    np.testing.assert_allclose(z, depth[rows, columns], rtol=1e-5)
    np.testing.assert_allclose(colors, image[rows, columns], rtol=1e-6)


def test_invalid_depth_is_dropped_and_bytes_become_colours():
    image, depth = picture()
    depth[0, :4] = [0.0, np.nan, np.inf, -1.0]
    points, colors = points_from_rgbd((255 * image).astype(np.uint8), depth, VIEWMAT, K)
    assert len(points) == HEIGHT * WIDTH - 4
    assert np.isfinite(points).all()
    assert colors.max() <= 1.0
    np.testing.assert_allclose(colors[0], image[0, 4], atol=1 / 255)


def test_no_depth_at_all_warns_and_gives_no_points():
    image, depth = picture()
    with pytest.warns(UserWarning, match="no pixel is positive"):
        points, colors = points_from_rgbd(image, 0 * depth, VIEWMAT, K)
    assert points.shape == colors.shape == (0, 3)


def test_depth_in_another_unit_is_noticed():
    image, depth = picture()
    with pytest.warns(UserWarning, match="millimetres"):
        points_from_rgbd(image, 1000 * depth, VIEWMAT, K)
    with pytest.raises(ValueError, match=r"expected floats in metres .*, found dtype uint16"):
        points_from_rgbd(image, (1000 * depth).astype(np.uint16), VIEWMAT, K)


def test_images_of_another_size_and_bad_strides_are_refused():
    image, depth = picture()
    with pytest.raises(ValueError, match=r"image: expected shape \(24, 32, 3\).*, found \(24, 31, 3\)"):
        points_from_rgbd(image[:, 1:], depth, VIEWMAT, K)
    with pytest.raises(ValueError, match="stride: expected 1 or more, found 0"):
        points_from_rgbd(image, depth, VIEWMAT, K, stride=0)


def test_quaternions_turn_z_onto_the_normal():
    normals = np.random.default_rng(0).normal(size=(50, 3))
    normals[:3] = [[0, 0, 1], [0, 0, -1], [1, 0, 0]]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    axes = np.asarray(quats_to_matrices(jnp.asarray(quats_from_normals(normals))))[:, :, 2]
    np.testing.assert_allclose(np.abs(np.sum(axes * normals, axis=1)), 1.0, atol=1e-6)
    np.testing.assert_array_equal(quats_from_normals(np.zeros((1, 3))), [[1, 0, 0, 0]])


def test_normals_of_a_tilted_plane():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 400))
    points = np.stack([x, y, 0.5 * x], axis=1)
    expected = np.array([-0.5, 0, 1]) / np.linalg.norm([-0.5, 0, 1])
    np.testing.assert_allclose(np.abs(estimate_normals(points) @ expected), 1.0, atol=1e-9)
    assert estimate_normals(points[:2]).shape == (2, 3)


def test_an_isolated_point_does_not_become_huge():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.01] * 2, [0.0]), axis=-1).reshape(-1, 3)
    scales = spacing_scales(np.concatenate([grid, [[5.0, 5.0, 5.0]]]))
    np.testing.assert_allclose(scales, 0.01, rtol=0.25)
    few = spacing_scales(np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [9.0, 9, 9]]))
    assert few.max() < 10  # its neighbours are far apart too; only finite and positive can be expected
    assert few.min() > 0


def test_coinciding_and_single_points_keep_an_extent():
    assert (spacing_scales(np.zeros((5, 3))) > 0).all()
    assert (spacing_scales(np.zeros((1, 3))) > 0).all()


def test_gaussians_are_thinned_sized_and_flat_along_the_normal():
    x, y = np.meshgrid(np.linspace(0, 1, 101), np.linspace(0, 1, 101))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    colors = np.full_like(points, 0.25)
    gaussians = gaussians_from_points(
        points, colors, voxel=0.05, normals="pca", flatness=0.1, scale_factor=0.5
    )
    assert 400 <= gaussians.num <= 441
    scales = np.asarray(gaussians.scales)
    np.testing.assert_allclose(np.median(scales[:, 0]), 0.025, rtol=0.1)
    np.testing.assert_allclose(scales[:, 2], 0.1 * scales[:, 0], rtol=1e-4)
    normals = np.asarray(quats_to_matrices(gaussians.quats))[:, :, 2]
    np.testing.assert_allclose(np.abs(normals[:, 2]), 1.0, atol=1e-5)
    spheres = gaussians_from_points(points, colors, voxel=0.05)
    np.testing.assert_array_equal(spheres.quats, np.tile([1.0, 0, 0, 0], (spheres.num, 1)))
    np.testing.assert_allclose(spheres.opacities, 0.9, rtol=1e-5)


def test_given_normals_follow_their_points_through_thinning():
    points = np.array([[0.0, 0, 0], [np.nan, 0, 0], [1.0, 0, 0]])
    normals = np.array([[1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    gaussians = gaussians_from_points(points, np.ones((3, 3)), normals=normals)
    axes = np.asarray(quats_to_matrices(gaussians.quats))[:, :, 2]
    np.testing.assert_allclose(axes, normals[[0, 2]], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.full((4, 3), np.nan)}, "none of the 4 is finite"),
        ({"points": np.zeros((0, 3)), "colors": np.zeros((0, 3))}, "none of the 0 is finite"),
        ({"colors": np.ones((3, 3))}, r"colors: expected shape \(4, 3\).*, found \(3, 3\)"),
        ({"normals": "guess"}, "normals: expected None, 'pca' or .*found 'guess'"),
        ({"normals": np.ones((2, 3))}, r"normals: expected shape \(4, 3\).*, found \(2, 3\)"),
    ],
)
def test_bad_arguments_are_refused(change, message):
    arguments = {"points": np.random.default_rng(0).normal(size=(4, 3)), "colors": np.ones((4, 3))} | change
    with pytest.raises(ValueError, match=message):
        gaussians_from_points(arguments.pop("points"), arguments.pop("colors"), **arguments)
