"""Outlines of masks snap to edges of the image."""

import cv2
import numpy as np
import pytest

from gsjax.perception.outlines import snap_outlines


def picture():
    """An image of a disc and a bar three pixels wide, and their true labels."""
    labels = np.zeros((60, 80), np.int64)
    cv2.circle(disc := np.zeros((60, 80), np.uint8), (25, 30), 15, 1, -1)
    labels[disc > 0] = 7
    labels[10:50, 60:63] = 3
    colors = {0: (90, 90, 90), 7: (200, 60, 40), 3: (40, 60, 200)}
    image = np.zeros((60, 80, 3), np.uint8)
    for label, color in colors.items():
        image[labels == label] = color
    noise = np.random.default_rng(0).integers(-6, 7, image.shape)
    return (image.astype(int) + noise).astype(np.uint8), labels


def overlap(one, other, label):
    return ((one == label) & (other == label)).sum() / ((one == label) | (other == label)).sum()


@pytest.mark.parametrize("change", [cv2.erode, cv2.dilate])
def test_an_outline_that_is_two_pixels_off_comes_to_lie_on_the_edge(change):
    image, labels = picture()
    off = change((labels == 7).astype(np.uint8), np.ones((5, 5)))
    flawed = np.where(off > 0, 7, np.where(labels == 3, 3, 0))
    found = snap_outlines(flawed, image, reach=3)
    assert overlap(flawed, labels, 7) < 0.8
    assert overlap(found, labels, 7) > 0.97


def test_what_is_thinner_than_the_reach_stays():
    image, labels = picture()
    found = snap_outlines(labels, image, reach=4)
    assert overlap(found, labels, 3) > 0.9
    assert set(np.unique(found)) == {0, 3, 7}


def test_what_nobody_knows_is_a_label_like_others_and_no_reach_changes_nothing():
    image, labels = picture()
    unknown = np.where(labels == 7, -1, labels)
    assert overlap(snap_outlines(unknown, image, 2), unknown, -1) > 0.97
    np.testing.assert_array_equal(snap_outlines(unknown, image, 0), unknown)
    plain = np.full_like(labels, 5)
    np.testing.assert_array_equal(snap_outlines(plain, image, 2), plain)


def test_further_from_the_outline_than_the_reach_nothing_changes():
    image, labels = picture()
    image = np.random.default_rng(1).integers(0, 256, image.shape, dtype=np.uint8)  # edges everywhere
    found = snap_outlines(labels, image, 2)
    inside = cv2.erode((labels == 7).astype(np.uint8), np.ones((5, 5))) > 0
    assert (found[inside] == 7).all()


def test_labels_of_another_picture_are_refused():
    image, labels = picture()
    with pytest.raises(
        ValueError, match=r"labels: expected \(60, 80\) pixels like the image, found \(59, 80\)"
    ):
        snap_outlines(labels[1:], image)
    with pytest.raises(ValueError, match="reach: expected 0 or more pixels, found -1"):
        snap_outlines(labels, image, -1)
