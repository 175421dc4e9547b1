"""Segmenters on synthetic images: boxes on a floor or in a tray; discs of uniform colour without depth."""

import numpy as np
import pytest

from gsjax.geometry.cameras import intrinsics, look_at
from gsjax.metrics.segmentation import iou_of_masks
from gsjax.perception.masks import name_by_size
from gsjax.perception.segmenters import (
    PieceSegmenter,
    PlaneOrRegionSegmenter,
    PlaneSegmenter,
    RegionSegmenter,
)

WIDTH, HEIGHT = 160, 120
K = intrinsics(140.0, WIDTH, HEIGHT)
VIEWMAT = look_at(np.array([0.0, -1.1, 0.9]), np.array([0.0, 0.1, 0.0]))


def ray_cast(boxes, floor=0.0, wall=1.0):
    """Depth and labels of boxes (lowest corner, highest corner, label) on a floor, in front of a wall."""
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    local = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
    directions, eye = local @ VIEWMAT[:3, :3], -VIEWMAT[:3, :3].T @ VIEWMAT[:3, 3]
    with np.errstate(divide="ignore"):
        to_floor, to_wall = (floor - eye[2]) / directions[..., 2], (wall - eye[1]) / directions[..., 1]
        depth = np.minimum(*(np.where(t > 0, t, np.inf) for t in (to_floor, to_wall)))
        labels = np.zeros((HEIGHT, WIDTH), int)
        for low, high, label in boxes:
            near, far = ((np.array(corner) - eye) / directions for corner in (low, high))
            enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
            hit = (enter < leave) & (enter > 0) & (enter < depth)
            depth, labels = np.where(hit, enter, depth), np.where(hit, label, labels)
    return depth, labels


TWO_BOXES = [((-0.35, -0.1, 0.0), (-0.05, 0.15, 0.2), 1), ((0.15, 0.0, 0.0), (0.3, 0.12, 0.1), 2)]
BLACK = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


def best_iou(predicted, true):
    return max(iou_of_masks(predicted == label, true) for label in range(1, predicted.max() + 1))


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_boxes_on_a_floor_before_a_wall_are_found_and_named_by_size(noise):
    depth, true = ray_cast(TWO_BOXES)
    depth = depth + noise * np.random.default_rng(0).normal(size=depth.shape)
    labels = PlaneSegmenter()(BLACK, depth, K)
    assert labels.dtype == np.int32
    assert labels.max() == 2
    assert iou_of_masks(labels == 1, true == 1) > 0.9
    assert iou_of_masks(labels == 2, true == 2) > 0.85


def test_a_box_in_a_tray_is_apart_from_the_tray():
    tray = [
        ((-0.3, -0.2, 0.0), (0.3, 0.3, 0.1), 3),  # its bottom, raised above the floor
        ((-0.3, -0.22, 0.0), (0.3, -0.2, 0.16), 3),
        ((-0.3, 0.3, 0.0), (0.3, 0.32, 0.16), 3),
        ((-0.32, -0.22, 0.0), (-0.3, 0.32, 0.16), 3),
        ((0.3, -0.22, 0.0), (0.32, 0.32, 0.16), 3),
    ]
    depth, true = ray_cast([*tray, ((-0.05, 0.0, 0.1), (0.1, 0.12, 0.2), 1)])
    assert best_iou(PlaneSegmenter()(BLACK, depth, K), true == 1) > 0.85


def test_a_box_before_another_is_split_off_by_its_jump_of_depth():
    boxes = [((-0.2, -0.3, 0.0), (0.0, -0.2, 0.2), 1), ((-0.1, 0.3, 0.0), (0.2, 0.5, 0.5), 2)]
    depth, true = ray_cast(boxes)
    labels = PlaneSegmenter()(BLACK, depth, K)
    assert best_iou(labels, true == 1) > 0.85
    assert best_iou(labels, true == 2) > 0.85


def test_touching_boxes_are_split_by_colour_if_asked():
    boxes = [((-0.3, 0.0, 0.0), (0.0, 0.2, 0.2), 1), ((0.0, 0.0, 0.0), (0.3, 0.2, 0.2), 2)]
    depth, true = ray_cast(boxes)
    image = np.array([[0, 0, 0], [250, 30, 30], [30, 30, 250]], np.uint8)[true]
    assert PlaneSegmenter()(image, depth, K).max() == 1
    labels = PlaneSegmenter(color_jump=12.0)(image, depth, K)
    assert best_iou(labels, true == 1) > 0.75
    assert best_iou(labels, true == 2) > 0.75


def test_the_same_picture_gives_the_same_labels_and_invalid_depth_is_background():
    depth, _ = ray_cast(TWO_BOXES)
    depth[:10], depth[60, 70:75] = 0.0, np.nan
    first, second = (PlaneSegmenter(seed=3)(BLACK, depth, K) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert not first[:10].any()


def test_an_empty_floor_holds_nothing():
    depth, _ = ray_cast([])
    assert not PlaneSegmenter()(BLACK, depth, K).any()


def test_a_plane_segmenter_names_what_it_needs():
    depth, _ = ray_cast(TWO_BOXES)
    with pytest.raises(ValueError, match="use RegionSegmenter"):
        PlaneSegmenter()(BLACK, None, K)
    with pytest.raises(ValueError, match="depth: expected positive, finite pixels, found none"):
        PlaneSegmenter()(BLACK, 0 * depth, K)
    with pytest.raises(ValueError, match=r"depth: expected shape \(120, 160\) .* found \(119, 160\)"):
        PlaneSegmenter()(BLACK, depth[1:], K)


def colored_discs():
    """A noisy grey image with a large and a small disc."""
    rows, columns = np.indices((HEIGHT, WIDTH))
    true = np.zeros((HEIGHT, WIDTH), int)
    true[(rows - 60) ** 2 + (columns - 50) ** 2 < 22**2] = 1
    true[(rows - 50) ** 2 + (columns - 120) ** 2 < 12**2] = 2
    colors = np.array([[0.5, 0.5, 0.5], [0.8, 0.2, 0.1], [0.1, 0.3, 0.8]])
    noise = np.random.default_rng(0).normal(0, 0.02, (HEIGHT, WIDTH, 3))
    return np.clip(colors[true] + noise, 0, 1), true


@pytest.mark.parametrize("as_bytes", [False, True])
def test_regions_of_like_colour_are_found_without_depth(as_bytes):
    image, true = colored_discs()
    image = (255 * image).astype(np.uint8) if as_bytes else image
    labels = RegionSegmenter()(image)
    assert labels.max() == 2
    assert iou_of_masks(labels == 1, true == 1) > 0.9
    assert iou_of_masks(labels == 2, true == 2) > 0.9


def test_a_picture_of_one_colour_holds_nothing():
    assert not RegionSegmenter()(np.full((40, 50, 3), 0.3)).any()


def test_the_segmenter_is_chosen_by_what_there_is():
    image, true = colored_discs()
    depth, boxes = ray_cast(TWO_BOXES)
    segment = PlaneOrRegionSegmenter()
    assert best_iou(segment(image, depth, K), boxes == 1) > 0.9
    assert best_iou(segment(image), true == 1) > 0.9
    for nothing in (0.0, np.inf, np.nan):
        assert best_iou(segment(image, np.full_like(depth, nothing), K), true == 1) > 0.9


def test_pieces_are_the_colours_of_what_stands_out():
    """The left box is red and green: two pieces. Colours of the floor are pieces only without depth."""
    depth, true = ray_cast(TWO_BOXES)
    image = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    image[90:, :40] = (30, 60, 200)  # a carpet
    columns = np.indices(true.shape)[1]
    middle = int(np.median(columns[true == 1]))
    image[(true == 1) & (columns < middle)], image[(true == 1) & (columns >= middle)] = (
        (200, 40, 40),
        (40, 170, 60),
    )
    image[true == 2] = (220, 200, 40)
    pieces = PieceSegmenter()(image, depth, K)
    assert (np.bincount(pieces.ravel())[1:] > 150).sum() == 3
    assert best_iou(pieces, (true == 1) & (columns < middle)) > 0.8
    assert best_iou(pieces, (true == 1) & (columns >= middle)) > 0.8
    assert (pieces[95:, :30] == 0).all()
    flat = PieceSegmenter()(image)
    assert (flat[95:, :30] > 0).all()
    for nothing in (0.0, np.inf, np.nan):
        np.testing.assert_array_equal(PieceSegmenter()(image, np.full_like(depth, nothing), K), flat)


def test_names_go_by_size_and_specks_are_dropped():
    labels = np.array([[7, 7, 0, 3, 3, 3, 9]])
    np.testing.assert_array_equal(name_by_size(labels), [[2, 2, 0, 1, 1, 1, 3]])
    np.testing.assert_array_equal(name_by_size(labels, min_pixels=2), [[2, 2, 0, 1, 1, 1, 0]])
