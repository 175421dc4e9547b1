"""Masks in pictures, as programs save them."""

import cv2
import numpy as np
import pytest
from PIL import Image

from gsjax.data import DataError
from gsjax.data.masks import read_mask, read_shades

WIDTH, HEIGHT = 12, 8
LABELS = (np.arange(WIDTH * HEIGHT) % 3).astype(np.uint8).reshape(HEIGHT, WIDTH)
WHITE = np.where(LABELS > 0, 255, 0).astype(np.uint8)
DAVIS = (0, 0, 0, 128, 0, 0, 0, 128, 0, 128, 128, 0)


def indexed(indices, palette):
    picture = Image.fromarray(indices, "P")
    picture.putpalette(palette)
    return picture


def stacked(*channels):
    return np.stack(np.broadcast_arrays(*channels), axis=-1).astype(np.uint8)


@pytest.fixture
def read(tmp_path):
    def call(picture, how=read_mask, **options):
        path = tmp_path / "mask.png"
        if isinstance(picture, np.ndarray):
            assert cv2.imwrite(str(path), picture)
        else:
            picture.save(path, **options)
        return how(path, WIDTH, HEIGHT)

    return call


@pytest.mark.parametrize(
    "palette",
    [
        DAVIS,
        (128, 64, 128, 0, 0, 0, 70, 70, 70),  # black is no label here
        (0, 0, 0, 51, 51, 51, 102, 102, 102),
        (0, 0, 0, 255, 255, 255, 255, 255, 255),
    ],
)
def test_indices_of_a_palette_are_labels(read, palette):
    np.testing.assert_array_equal(read(indexed(LABELS, palette)), LABELS)
    np.testing.assert_array_equal(read(indexed(LABELS, palette), transparency=0), LABELS)
    np.testing.assert_array_equal(read(indexed(LABELS, palette), bits=2), LABELS)


@pytest.mark.parametrize(
    ("picture", "labels"),
    [
        (LABELS, LABELS),
        (LABELS.astype(np.uint16) * 300, LABELS.astype(int) * 300),
        (Image.fromarray(LABELS > 0), WHITE),
        (stacked(LABELS, LABELS, LABELS), LABELS),
        (stacked(LABELS, LABELS, LABELS, 255), LABELS),
        (stacked(255, 255, 255, WHITE), WHITE),
        (Image.fromarray(stacked(255, WHITE), "LA"), WHITE),
        (Image.fromarray(stacked(WHITE, 255), "LA"), WHITE),
    ],
    ids=["8 bits", "16 bits", "1 bit", "equal channels", "opaque", "RGBA", "grey and alpha", "grey, opaque"],
)
def test_one_channel_or_equal_ones(read, picture, labels):
    np.testing.assert_array_equal(read(picture), labels)
    np.testing.assert_array_equal(read(picture, read_shades), labels)


def test_a_grey_picture_that_was_saved_small_has_its_shades(read):
    expected = np.vectorize({0: 255, 1: 0, 2: 90}.get)(LABELS)
    np.testing.assert_array_equal(read(indexed(LABELS, (255, 255, 255, 0, 0, 0, 90, 90, 90))), expected)


@pytest.mark.parametrize(
    ("palette", "of"),
    [
        (DAVIS, {0: 0, 1: 255, 2: 255}),
        ((9, 9, 200, 0, 0, 0, 200, 9, 9), {0: 255, 1: 0, 2: 255}),
        ((0, 0, 0, 51, 51, 51, 255, 255, 255), {0: 0, 1: 51, 2: 255}),
        ((255, 255, 255, 0, 0, 0, 90, 90, 90), {0: 255, 1: 0, 2: 90}),
    ],
)
def test_shades_of_a_palette(read, palette, of):
    np.testing.assert_array_equal(read(indexed(LABELS, palette), read_shades), np.vectorize(of.get)(LABELS))


def test_black_and_one_colour_tell_what_counts_but_are_no_labels(read):
    red = stacked(0, 0, WHITE)
    np.testing.assert_array_equal(read(red, read_shades), WHITE)
    with pytest.raises(DataError, match="expected one label per pixel, found 3 channels that differ"):
        read(red)
    with pytest.raises(DataError, match="expected one label per pixel, found 3 channels that differ"):
        read(stacked(0, 90 * LABELS, WHITE), read_shades)


def test_black_before_transparency_means_nothing(read):
    with pytest.raises(DataError, match="found black everywhere that is not transparent"):
        read(stacked(0, 0, 0, WHITE))


def test_a_palette_that_is_cut_off_is_refused(tmp_path):
    indexed(LABELS, DAVIS).save(tmp_path / "mask.png")
    content = (tmp_path / "mask.png").read_bytes()
    (tmp_path / "mask.png").write_bytes(content[:-15])
    with pytest.raises(DataError, match="expected a mask, found a file that is cut off"):
        read_mask(tmp_path / "mask.png", WIDTH, HEIGHT)
