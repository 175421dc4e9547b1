"""Labels of an initial scene: lifted from one view, and inherited along surfaces by points out of sight."""

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from gsjax.geometry.cameras import intrinsics
from gsjax.scene.initialize import points_from_rgbd
from gsjax.scene.labels import inherit_labels, lift_labels

WIDTH, HEIGHT = 32, 24
K = intrinsics(40.0, WIDTH, HEIGHT)


def box_before_wall():
    """Depth and mask of a view: a box with label 1, at 1 m, in front of a wall at 2 m."""
    depth, mask = np.full((HEIGHT, WIDTH), 2.0), np.zeros((HEIGHT, WIDTH), np.int32)
    depth[8:16, 10:20], mask[8:16, 10:20] = 1.0, 1
    return depth, mask


def test_labels_are_lifted_only_where_the_depth_agrees():
    depth, mask = box_before_wall()
    points = np.array(
        [
            [0.0, 0.0, 1.0],  # on the box
            [0.0, 0.0, 1.01],  # just behind its surface
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
    # The same surfaces as another camera would have sampled them: no label of the box reaches the wall.
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


def test_a_mask_of_another_size_is_reported():
    depth, mask = box_before_wall()
    points = np.array([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"mask: expected shape \(24, 32\).*, found \(23, 32\)"):
        lift_labels(points, mask[1:], depth, np.eye(4), K)


def sheet(origin, one, other, spacing=0.005):
    """Points of a parallelogram, and a normal for each."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    a = np.arange(0, np.linalg.norm(one), spacing)[:, None, None] * one / np.linalg.norm(one)
    b = np.arange(0, np.linalg.norm(other), spacing)[None, :, None] * other / np.linalg.norm(other)
    points = (np.asarray(origin) + a + b).reshape(-1, 3)
    normal = np.cross(one, other)
    return points, np.tile(normal / np.linalg.norm(normal), (len(points), 1))


def box_on_table():
    """Points and normals of the top (0) and one side (1) of a 10 cm box and of the table (2) in front of that
    side, and the number of each point's sheet."""
    top = sheet([0, 0, 0.1], [0.1, 0, 0], [0, 0.1, 0])
    side = sheet([0, 0, 0.005], [0.1, 0, 0], [0, 0, 0.09])  # its normal is -y: outward
    table = sheet([0, -0.3, 0], [0.1, 0, 0], [0, 0.295, 0])
    names = np.repeat([0, 1, 2], [len(top[0]), len(side[0]), len(table[0])])
    points, normals = (np.concatenate(parts) for parts in zip(top, side, table, strict=True))
    return points, normals, names


def test_a_hidden_side_takes_the_label_of_its_box_and_not_of_the_table():
    points, normals, names = box_on_table()
    truth = np.where(names == 2, 0, 7)
    hidden = (names == 1) | ((names == 2) & (points[:, 1] > -0.02))
    labels = inherit_labels(points, np.where(hidden, -1, truth), normals)
    np.testing.assert_array_equal(labels, truth)
    # By Euclidean distance alone the lower half of the side would take the table's label.
    flat = inherit_labels(points, np.where(hidden, -1, truth), 0 * normals + [0, 0, 1.0])
    assert (flat[names == 1] == 0).mean() > 0.3


def test_labels_stop_at_a_distance_and_at_gaps():
    points = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])
    labels, normals = np.array([3, -1, -1, 0, -1]), np.tile([0, 0, 1.0], (5, 1))
    np.testing.assert_array_equal(inherit_labels(points, labels, normals), [3, 3, 3, 0, 0])
    np.testing.assert_array_equal(
        inherit_labels(points, labels, normals, max_distance=0.015), [3, 3, 0, 0, 0]
    )
    np.testing.assert_array_equal(inherit_labels(points, labels, normals, max_step=0.005), [3, 0, 0, 0, 0])
    np.testing.assert_array_equal(inherit_labels(points, np.full(5, -1), normals), 0)
    np.testing.assert_array_equal(inherit_labels(points[:1], labels[:1], normals[:1]), [3])
    assert inherit_labels(points[:0], labels[:0], normals[:0]).shape == (0,)


def test_there_must_be_one_label_and_one_normal_per_point():
    points = np.zeros((5, 3))
    with pytest.raises(ValueError, match=r"labels: expected shape \[5\].*, found \(4,\)"):
        inherit_labels(points, np.zeros(4, int), points)
    with pytest.raises(ValueError, match=r"normals: expected shape \(5, 3\).*, found \(4, 3\)"):
        inherit_labels(points, np.zeros(5, int), points[:4])


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_known_labels_are_kept_and_no_label_is_invented(seed):
    rng = np.random.default_rng(seed)
    points = 0.05 * rng.normal(size=(40, 3))
    points[rng.random(40) < 0.1] = points[0]  # coinciding points
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    labels = rng.integers(-1, 4, 40)
    inherited = inherit_labels(points, labels, normals)
    known = labels >= 0
    np.testing.assert_array_equal(inherited[known], labels[known])
    assert set(inherited) <= {0, *labels[known].tolist()}
