"""Labels propagated through synthetic images with known motion."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.transform import ProjectiveTransform, warp

from gsjax.methods.protocols import Propagator
from gsjax.metrics.segmentation import iou_of_masks
from gsjax.perception.propagation import FlowPropagator

HEIGHT, WIDTH, SIDE = 96, 128, 30
COLORS = np.array([(0.45, 0.45, 0.45), (0.75, 0.3, 0.2), (0.2, 0.35, 0.75)])


def texture(seed, size, color):
    """A speckled image [H, W, 3] around one colour."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=size), 1.0)
    return np.clip(color + 0.08 * (noise / noise.std())[..., None], 0, 1)


def squares(*corners, seed=0):
    """Image and labels 1, 2, ... of squares at (row, column) on a speckled wall, later ones on top."""
    image = texture(seed, (HEIGHT, WIDTH), COLORS[0])
    labels = np.zeros((HEIGHT, WIDTH), np.int32)
    for name, (row, column) in enumerate(corners, start=1):
        rows = slice(max(row, 0), max(row + SIDE, 0))
        columns = slice(max(column, 0), max(column + SIDE, 0))
        own = texture(name, (SIDE, SIDE), COLORS[name])[max(-row, 0) :, max(-column, 0) :]
        height, width = labels[rows, columns].shape
        image[rows, columns] = own[:height, :width]
        labels[rows, columns] = name
    return image, labels


def movie(*paths):
    """Images and labels [V, H, W, ...] of squares with corners [V, 2]."""
    views = [squares(*corners) for corners in zip(*paths, strict=True)]
    return tuple(np.stack(part) for part in zip(*views, strict=True))


def path(start, step, count):
    return np.array(start) + np.arange(count)[:, None] * np.array(step)


def still(image, other):
    return np.zeros((*image.shape[:2], 2), np.float32)


def test_squares_that_move_keep_their_labels():
    images, true = movie(path((10, 8), (3, 4), 8), path((50, 90), (-2, -3), 8))
    propagate = FlowPropagator()
    assert isinstance(propagate, Propagator)
    found = propagate(images, true[0])
    assert found.dtype == true.dtype
    np.testing.assert_array_equal(found[0], true[0])
    for label in (1, 2):
        for view in range(8):
            assert iou_of_masks(found[view] == label, true[view] == label) > 0.9


def test_labels_follow_a_camera_that_turns_and_nears():
    image, labels = squares((12, 14), (50, 70))
    views, true = [], []
    for i in range(6):
        nearer, turned = 1 - 0.02 * i, 0.01 * i
        to_source = ProjectiveTransform(
            np.array([[nearer, turned, 1.5 * i], [-turned, nearer, 1.0 * i], [1e-4 * i, 0, 1]])
        )
        views.append(warp(image, to_source, mode="reflect"))
        true.append(warp(labels, to_source, order=0, preserve_range=True).astype(np.int32))
    found = FlowPropagator()(np.stack(views), labels)
    assert (true[-1] != labels).mean() > 0.05
    for label in (1, 2):
        assert iou_of_masks(found[-1] == label, true[-1] == label) > 0.9


def test_what_leaves_the_picture_takes_its_label_along():
    images, true = movie(path((30, 90), (0, 3), 15), path((50, 20), (0, 0), 15))
    assert not (true[-1] == 1).any()
    found = FlowPropagator()(images, true[0])
    for view in range(12):
        assert iou_of_masks(found[view] == 1, true[view] == 1) > 0.9
    assert not (found[-1] == 1).any()
    assert iou_of_masks(found[-1] == 2, true[-1] == 2) > 0.95


def test_what_leaves_too_fast_for_the_flow_leaves_no_label_behind():
    images, true = movie(path((30, 90), (0, 6), 9), path((50, 20), (0, 0), 9))
    found = FlowPropagator()(images, true[0])
    assert not ((found == 1) & (true != 1))[3:].any()
    # Only the colours show that the flow is wrong.
    blind = FlowPropagator(max_color_change=1e3)(images, true[0])
    assert (blind[-1] == 1).any()


def test_what_is_hidden_leaves_nothing_on_what_hides_it():
    images, true = movie(path((40, 50), (0, 0), 8), path((40, 2), (0, 6), 8))
    found = FlowPropagator()(images, true[0])
    assert iou_of_masks(found[-1] == 2, true[-1] == 2) > 0.9
    assert not (found[-1] == 1)[true[-1] == 2].any()


def hide(hidden):
    """Zero flow that is unknown where `hidden` [H, W]."""
    return lambda image, other: np.where(hidden[..., None], np.nan, still(image, other))


def test_what_is_not_known_is_flooded_up_to_edges_of_colour():
    image, labels = squares((20, 20), (50, 80))
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[15:55, 35:55] = True  # the right half of a square, and the wall next to it
    hidden[70:90, 60:100] = True  # the lower left of the other
    found = FlowPropagator(flow=hide(hidden))(np.stack([image, image]), labels)[1]
    np.testing.assert_array_equal(found[~hidden], labels[~hidden])
    assert (found == labels)[hidden].mean() > 0.97


def test_labels_do_not_flood_far():
    image = texture(0, (HEIGHT, WIDTH), COLORS[1])
    hidden = np.indices((HEIGHT, WIDTH))[1] >= 50
    found = FlowPropagator(flow=hide(hidden), reach=10.0)(
        np.stack([image, image]), np.ones((HEIGHT, WIDTH), np.int32)
    )[1]
    assert found[:, :58].all()
    assert not found[:, 60:].any()


def test_where_flow_is_not_known_or_does_not_lead_back_all_is_background():
    image, labels = squares((20, 20))
    images = np.stack([image, image])
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    assert not FlowPropagator(flow=hide(everywhere))(images, labels)[1].any()
    assert not FlowPropagator(flow=lambda image, other: still(image, other) + 1.0)(images, labels)[1].any()


def test_labels_are_names_and_bytes_mean_the_same_as_floats():
    images, true = movie(path((20, 20), (2, 3), 3), path((50, 80), (0, -3), 3))
    images = np.round(255 * images).astype(np.uint8)
    found = FlowPropagator()(images, true[0])
    names = np.array([0, 40, 7], np.int32)
    np.testing.assert_array_equal(FlowPropagator()(images, names[true[0]]), names[found])
    np.testing.assert_array_equal(FlowPropagator()(images / 255.0, true[0]), found)


def test_one_picture_is_done_and_labels_of_another_size_are_refused():
    image, labels = squares((20, 20))
    np.testing.assert_array_equal(FlowPropagator()(image[None], labels), labels[None])
    with pytest.raises(
        ValueError, match=r"labels: expected shape \(96, 128\) to match images, found \(95, 128\)"
    ):
        FlowPropagator()(image[None], labels[1:])
