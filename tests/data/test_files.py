"""Single pictures in all formats that programs save."""

import cv2
import numpy as np
import pytest
from PIL import Image

from gsjax.data import DataError
from gsjax.data.files import picture_size, read_image, read_rgba

WIDTH, HEIGHT = 12, 8
RAMP = np.arange(WIDTH * HEIGHT * 3, dtype=np.uint16).reshape(HEIGHT, WIDTH, 3)


def write(path, bgr):
    assert cv2.imwrite(str(path), bgr)
    return path


def test_sixteen_bits_become_eight(tmp_path):
    """65535 / 255 is 257: full scale stays full scale, and half steps are rounded."""
    raw = (RAMP * 200).astype(np.uint16)
    raw[0, 0] = 65535, 257 * 100 + 128, 257 * 100 + 129
    read = read_rgba(write(tmp_path / "a.png", raw[..., ::-1]), WIDTH, HEIGHT)
    assert read.dtype == np.uint8
    assert read[0, 0].tolist() == [255, 100, 101]
    np.testing.assert_array_equal(read, np.round(raw / 257))


def test_sixteen_bits_with_transparency(tmp_path):
    raw = np.full((HEIGHT, WIDTH, 4), 65535, np.uint16)
    raw[..., 0], raw[2:, :, 3] = 0, 257 * 51
    read = read_rgba(write(tmp_path / "a.png", raw[..., [2, 1, 0, 3]]), WIDTH, HEIGHT)
    assert (read[0, 0].tolist(), read[5, 5].tolist()) == ([0, 255, 255, 255], [0, 255, 255, 51])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_has_three_equal_channels(tmp_path, dtype):
    grey = np.full((HEIGHT, WIDTH), np.iinfo(dtype).max // 5, dtype)
    grey[0] = 0
    read = read_rgba(write(tmp_path / "a.png", grey), WIDTH, HEIGHT)
    assert (read.shape, read[0, 0].tolist(), read[1, 0].tolist()) == ((HEIGHT, WIDTH, 3), [0] * 3, [51] * 3)


def test_a_palette_is_looked_up(tmp_path):
    colors = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    colors[:4], colors[4:] = (250, 120, 3), (9, 80, 160)
    picture = Image.fromarray(colors).quantize(2)
    assert picture.mode == "P"
    picture.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", WIDTH, HEIGHT), colors)
    transparent = picture.getpixel((0, 0))
    picture.save(tmp_path / "b.png", transparency=transparent)
    read = read_rgba(tmp_path / "b.png", WIDTH, HEIGHT)
    assert read.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(read[4:, :, :3], colors[4:])
    assert (read[:4, :, 3].max(), read[4:, :, 3].min()) == (0, 255)


def test_black_and_white_of_one_bit(tmp_path):
    bits = np.zeros((HEIGHT, WIDTH), bool)
    bits[:, 3:] = True
    Image.fromarray(bits).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_rgba(tmp_path / "a.png", WIDTH, HEIGHT)[..., 1], 255 * bits)


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize("keep", [0.95, 0.5, 30])
def test_a_truncated_picture_is_refused(tmp_path, ending, keep):
    path = write(tmp_path / f"a.{ending}", cv2.resize(RAMP.astype(np.uint8), (200, 100)))
    content = path.read_bytes()
    path.write_bytes(content[: keep if isinstance(keep, int) else int(keep * len(content))])
    for read in (read_rgba, read_image):
        with pytest.raises(DataError, match=rf"a.{ending}: expected an image, found a file that is cut off"):
            read(path, 200, 100)


def test_pictures_of_floats_are_refused(tmp_path):
    path = write(tmp_path / "a.tif", np.zeros((HEIGHT, WIDTH, 3), np.float32))
    with pytest.raises(DataError, match=r"an image of 8 or 16 bits, found float32. Save it as PNG"):
        read_rgba(path, WIDTH, HEIGHT)


def test_the_size_comes_from_the_file_header(tmp_path):
    path = write(tmp_path / "a.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert picture_size(path) == (WIDTH, HEIGHT)
    with pytest.raises(DataError, match=r"b.png: expected an image, found no such file"):
        picture_size(tmp_path / "b.png")
