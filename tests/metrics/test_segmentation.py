"""Overlap of labels, pooled over images."""

import math

import numpy as np
import pytest

from gsjax.metrics.segmentation import LabelOverlap, MaskOverlap, boundary, iou_of_masks


def test_counts_are_pooled_over_pictures():
    overlap = LabelOverlap()
    overlap.add(np.array([[1, 1, 0, 0]]), np.array([[1, 0, 0, 0]]))  # 1: 1 of 2
    overlap.add(np.array([[1] * 8]), np.array([[1] * 8]))  # 1: 8 of 8
    assert overlap.iou(1) == pytest.approx(9 / 10)  # and not the mean of 1/2 and 1
    assert overlap.iou(0) == pytest.approx(2 / 3)
    assert overlap.mean_iou() == pytest.approx((9 / 10 + 2 / 3) / 2)
    assert overlap.mean_iou([1, 99]) == pytest.approx(9 / 10)
    assert overlap.labels == [0, 1]


def test_dice_follows_from_iou():
    rng = np.random.default_rng(0)
    overlap = LabelOverlap()
    overlap.add(rng.integers(0, 4, (30, 30)), rng.integers(0, 4, (30, 30)))
    for label in range(4):
        iou = overlap.iou(label)
        assert overlap.dice(label) == pytest.approx(2 * iou / (1 + iou))


def test_f1_is_dice_and_accuracy_is_the_share_that_is_right():
    rng = np.random.default_rng(1)
    predicted, true = rng.integers(-1, 4, (2, 30, 30))
    overlap = LabelOverlap()
    overlap.add(predicted, true)
    predicted, true = predicted[true >= 0], true[true >= 0]
    scores = []
    for label in range(4):
        precision, recall = (
            (true[predicted == label] == label).mean(),
            (predicted[true == label] == label).mean(),
        )
        scores.append(2 / (1 / precision + 1 / recall))
        assert overlap.f1(label) == pytest.approx(scores[-1])
        assert overlap.dice(label) == pytest.approx(scores[-1])
    assert overlap.mean(overlap.f1, range(5)) == pytest.approx(np.mean(scores))  # there is no label 4
    assert overlap.accuracy == pytest.approx((predicted == true).mean())


def test_f1_of_a_label_that_is_never_hit_or_never_there():
    overlap = LabelOverlap()
    assert math.isnan(overlap.accuracy)
    overlap.add(np.array([1, 2]), np.array([2, 3]))
    assert [overlap.f1(label) for label in (1, 2, 3)] == [0, 0, 0]
    assert math.isnan(overlap.f1(4))
    assert overlap.accuracy == 0


def test_unknown_pixels_and_labels_never_seen_score_nothing():
    overlap = LabelOverlap()
    overlap.add(np.array([[1, 2]], np.uint8), np.array([[1, -1]]))
    assert overlap.iou(1) == 1.0
    assert math.isnan(overlap.iou(2))
    assert math.isnan(LabelOverlap().mean_iou())


def test_unknown_predictions_miss_but_are_no_class_of_their_own():
    overlap = LabelOverlap()
    overlap.add(np.array([[1, -1, 2]]), np.array([[1, 1, 2]]))
    assert overlap.labels == [1, 2]
    assert overlap.mean_iou() == pytest.approx((0.5 + 1) / 2)


def test_masks_and_shapes():
    assert iou_of_masks(np.array([True, True, False]), np.array([False, True, False])) == 0.5
    assert math.isnan(iou_of_masks(np.zeros(3, bool), np.zeros(3, bool)))
    with pytest.raises(ValueError, match=r"predicted: expected shape \(3,\) to match true, found \(2,\)"):
        LabelOverlap().add(np.zeros(2, int), np.zeros(3, int))


def square(low, high, size=200):
    mask = np.zeros((size, size), bool)
    mask[low:high, low:high] = True
    return mask


def test_a_boundary_is_a_band_of_two_percent_of_the_diagonal():
    band = boundary(square(50, 150))
    reach = round(0.02 * np.hypot(200, 200))
    assert band.sum() == 100**2 - (100 - 2 * reach) ** 2
    assert not band[100, 100]
    whole = boundary(square(0, 200))
    assert whole[0, 0]
    assert not whole[100, 100]  # the edge of the image counts as outline
    np.testing.assert_array_equal(boundary(square(50, 53)), square(50, 53))


def test_boundaries_see_of_large_masks_what_areas_do_not():
    overlap = MaskOverlap()
    overlap.add(square(12, 190), square(10, 190))
    assert overlap.iou > 0.97
    assert overlap.boundary_iou < 0.85
    overlap.add(square(10, 190), square(10, 190))
    assert overlap.iou == pytest.approx((178**2 + 180**2) / (2 * 180**2))


def test_overlaps_of_nothing_are_no_numbers():
    overlap = MaskOverlap()
    assert np.isnan(overlap.iou)
    assert np.isnan(overlap.boundary_iou)
