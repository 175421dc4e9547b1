"""First scenes: points from depth, their sizes and normals, labels lifted from one view and inherited."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at, project
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.scene.initialize import (
    estimate_normals,
    gaussians_from_points,
    inherit_labels,
    lift_labels,
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
    with pytest.raises(ValueError, match="got dtype uint16, want metres as floats"):
        points_from_rgbd(image, (1000 * depth).astype(np.uint16), VIEWMAT, K)


def test_images_of_another_size_and_bad_strides_are_refused():
    image, depth = picture()
    with pytest.raises(ValueError, match=r"image: got shape \(24, 31, 3\), want \(24, 32, 3\)"):
        points_from_rgbd(image[:, 1:], depth, VIEWMAT, K)
    with pytest.raises(ValueError, match="stride: got 0"):
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


def test_a_lone_point_gets_no_giant():
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.01] * 2, [0.0]), axis=-1).reshape(-1, 3)
    scales = spacing_scales(np.concatenate([grid, [[5.0, 5.0, 5.0]]]))
    np.testing.assert_allclose(scales, 0.01, rtol=0.25)
    few = spacing_scales(np.array([[0.0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [9.0, 9, 9]]))
    assert few.max() < 10  # its neighbours are far themselves; finite and positive is all that can be asked
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
        ({"colors": np.ones((3, 3))}, r"colors: got shape \(3, 3\), want \(4, 3\)"),
        ({"normals": "guess"}, "normals: got 'guess'"),
        ({"normals": np.ones((2, 3))}, r"normals: got shape \(2, 3\), want \(4, 3\)"),
    ],
)
def test_what_makes_no_cloud_is_refused(change, message):
    arguments = {"points": np.random.default_rng(0).normal(size=(4, 3)), "colors": np.ones((4, 3))} | change
    with pytest.raises(ValueError, match=message):
        gaussians_from_points(arguments.pop("points"), arguments.pop("colors"), **arguments)


def box_before_wall():
    """A view in which label 1, at 1 m, stands before a wall at 2 m."""
    depth, mask = np.full((HEIGHT, WIDTH), 2.0), np.zeros((HEIGHT, WIDTH), np.int32)
    depth[8:16, 10:20], mask[8:16, 10:20] = 1.0, 1
    return depth, mask


def test_labels_are_lifted_only_where_the_depth_agrees():
    depth, mask = box_before_wall()
    points = np.array(
        [
            [0.0, 0.0, 1.0],  # on the box
            [0.0, 0.0, 1.01],  # a hair behind its surface
            [0.0, 0.0, 1.05],  # inside the box
            [0.0, 0.0, 2.0],  # on the wall, behind the box
            [0.7, 0.0, 2.0],  # on the wall, in sight
            [9.0, 0.0, 2.0],  # outside the picture
            [0.0, 0.0, -1.0],  # behind the camera
        ]
    )
    for dtype in (np.int32, np.uint8, np.int64):
        labels = lift_labels(points, mask.astype(dtype), depth, np.eye(4), K)
        np.testing.assert_array_equal(labels, [1, 1, -1, -1, 0, -1, -1])
        assert labels.dtype == np.int32


def test_labels_do_not_bleed_across_an_occlusion_edge():
    depth, mask = box_before_wall()
    points, _ = points_from_rgbd(np.zeros((HEIGHT, WIDTH, 3)), depth, np.eye(4), K)
    np.testing.assert_array_equal(lift_labels(points, mask, depth, np.eye(4), K), mask.ravel())
    # The same surfaces as another camera would have sampled them: the wall takes nothing from the box.
    shifted = points + np.array([0.013, 0.017, 0.0])
    labels = lift_labels(shifted, mask, depth, np.eye(4), K)
    assert not (labels[points[:, 2] > 1.5] == 1).any()
    assert (labels == 1).any()


def test_invalid_depth_lifts_nothing():
    depth, mask = box_before_wall()
    depth[8:16, 10:20] = 0.0
    with pytest.warns(UserWarning, match=r"label \[1\] reached no point"):
        labels = lift_labels(np.array([[0.0, 0, 1.0]]), mask, depth, np.eye(4), K)
    np.testing.assert_array_equal(labels, [-1])
    with pytest.raises(ValueError, match="no label can be lifted"):
        lift_labels(np.array([[0.0, 0, 1.0]]), mask, 0 * depth, np.eye(4), K)


def test_a_mask_of_another_size_and_a_label_without_pixels_are_told():
    depth, mask = box_before_wall()
    points = np.array([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"mask: got shape \(23, 32\), want \(24, 32\)"):
        lift_labels(points, mask[1:], depth, np.eye(4), K)
    with pytest.warns(UserWarning, match=r"no pixel has label \[7\]; it holds \[0, 1\]"):
        lift_labels(points, mask, depth, np.eye(4), K, expected_labels=[1, 7])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lift_labels(points, mask, depth, np.eye(4), K, expected_labels=[1])


def test_unknown_points_inherit_up_to_a_distance():
    points = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])
    labels = np.array([3, -1, -1, 0, -1])
    np.testing.assert_array_equal(inherit_labels(points, labels, max_distance=0.03), [3, 3, 3, 0, 0])
    np.testing.assert_array_equal(inherit_labels(points, np.full(5, -1)), 0)
    with pytest.raises(ValueError, match=r"labels: got shape \(4,\), want \[5\]"):
        inherit_labels(points, labels[:4])
