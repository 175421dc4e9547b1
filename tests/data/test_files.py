"""Single pictures in all formats that programs save."""

import io
import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from gsjax.data import DataError, DataWarning
from gsjax.data.files import (
    as_numbers,
    find_background,
    image_size,
    picture_size,
    read_image,
    read_json,
    read_rgba,
    read_text,
)
from gsjax.data.pictures import warn_of_truncated

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


def jpeg(**options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.tile(RAMP.astype(np.uint8), (5, 5, 1))).save(file, "JPEG", **options)
    return file.getvalue()


def with_thumbnail(content: bytes) -> bytes:
    """The JPEG with an EXIF thumbnail, itself a JPEG, whose end marker is not that of the photograph."""
    thumbnail = jpeg(quality=20)
    segment = b"Exif\0\0" + thumbnail
    return content[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + content[2:]


def large(ending: str) -> bytes:
    """A picture with more bytes than the check reads first."""
    noise = np.random.default_rng(0).integers(0, 256, (1000, 1000, 3), np.uint8)
    return cv2.imencode(ending, noise)[1].tobytes()


WHOLE = {
    "baseline": jpeg(),
    "progressive": jpeg(progressive=True),
    "restart marks": jpeg(restart_marker_blocks=1),
    "thumbnail": with_thumbnail(jpeg()),
    "grey": cv2.imencode(".jpg", np.tile(RAMP[..., 0].astype(np.uint8), (5, 5)))[1].tobytes(),
    "PNG": cv2.imencode(".png", np.tile(RAMP.astype(np.uint8), (5, 5, 1)))[1].tobytes(),
}
TAILS = {"zeros": bytes(3000), "0xff": b"\xff" * 100, "film": b"\0\0\0\x18ftypmp42" * 50, "picture": jpeg()}


@pytest.mark.parametrize("form", WHOLE)
@pytest.mark.parametrize("tail", TAILS)
def test_bytes_behind_the_end_of_a_picture_do_not_matter(tmp_path, form, tail):
    path = tmp_path / "a.jpg"
    path.write_bytes(WHOLE[form])
    alone = read_image(path, 5 * WIDTH, 5 * HEIGHT)
    path.write_bytes(WHOLE[form] + TAILS[tail])
    np.testing.assert_array_equal(read_image(path, 5 * WIDTH, 5 * HEIGHT), alone)


@pytest.mark.parametrize("form", WHOLE)
@pytest.mark.parametrize("tail", ["nothing", "zeros", "0xff"])
def test_wherever_a_picture_is_cut_off_it_is_refused(tmp_path, form, tail):
    """Also where a download had allocated the whole file in advance."""
    path, content = tmp_path / "a.jpg", WHOLE[form]
    for length in range(30, len(content) - 13, 7):
        path.write_bytes(content[:length] + TAILS.get(tail, b""))
        with pytest.raises(DataError, match=r"expected an image, found a file that is cut off"):
            read_image(path, 5 * WIDTH, 5 * HEIGHT)


@pytest.mark.parametrize("mode", ["RGBA", "LA", "P", "L"])
def test_what_is_transparent_shows_the_background(tmp_path, mode):
    """However the file encodes transparency; `find_background` finds out whether any picture has it."""
    grey = np.full((HEIGHT, WIDTH, 4), 200, np.uint8)
    grey[..., 3], grey[:4] = 255, (90, 90, 90, 0)
    picture = Image.fromarray(grey)
    if mode in ("P", "L"):
        first = Image.fromarray(grey[..., :3]).convert("L")
        first.convert(mode).save(tmp_path / "a.png", transparency=90)
    else:
        picture.convert(mode).save(tmp_path / "a.png")
    read = read_image(tmp_path / "a.png", WIDTH, HEIGHT, (0.0, 0.0, 1.0))
    assert (read[0, 0].tolist(), read[5, 5].tolist()) == ([0, 0, 255], [200, 200, 200])
    assert read_image(tmp_path / "a.png", WIDTH, HEIGHT)[0, 0].tolist() == [0, 0, 0]
    picture.convert("RGB").save(tmp_path / "b.png")
    picture.convert("RGB").convert("RGBA").save(tmp_path / "c.png")
    assert find_background([tmp_path / "b.png", tmp_path / "a.png"]) == (1, 1, 1)
    assert find_background([tmp_path / "b.png", tmp_path / "c.png"]) is None


HEIC = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(99)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        (
            "a.HEIC",
            HEIC,
            "found HEIC, a format that is not read. Convert to JPEG or PNG first, .*heif-convert",
        ),
        ("a.jpg", HEIC, "found HEIC, a format that is not read. Convert"),
        ("a.heif", b"anything", "found HEIC, a format that is not read. Convert"),
        ("a.avif", b"\0\0\0\x18ftypavif" + bytes(99), "found AVIF, a format that is not read. Convert"),
        ("a.jxl", b"\xff\x0a" + bytes(99), "found JPEG XL, a format that is not read. Convert"),
        ("a.CR3", b"\0\0\0\x18ftypcrx \0\0", "found camera raw, a format that is not read. Develop to JPEG"),
        (
            "a.tif",
            b"II*\0\x10\0\0\0CR\2\0" + bytes(99),
            "found camera raw, a format that is not read. Develop",
        ),
        ("a.jpg", b"text", r"found something else \(.*\). Fetch the file again"),
    ],
)
def test_formats_that_are_not_read_are_named(tmp_path, name, content, says):
    path = tmp_path / name
    path.write_bytes(content)
    for read in (picture_size, lambda path: read_image(path, WIDTH, HEIGHT), image_size):
        with pytest.raises(DataError, match=rf"{name}: expected an image, {says}"):
            read(path)


@pytest.mark.parametrize("name", ["a.NEF", "a.dng"])
def test_the_thumbnail_of_raw_data_is_not_taken_for_the_photograph(tmp_path, name):
    """Raw files are TIFF files, of which decoders read the first picture: the thumbnail."""
    Image.fromarray(RAMP.astype(np.uint8)).save(tmp_path / name, "TIFF")
    for read in (picture_size, lambda path: read_image(path, WIDTH, HEIGHT)):
        with pytest.raises(DataError, match="found camera raw, a format that is not read"):
            read(tmp_path / name)


def test_a_jpeg_is_read_whatever_its_name(tmp_path):
    (tmp_path / "a.HEIC").write_bytes(WHOLE["baseline"])
    assert picture_size(tmp_path / "a.HEIC") == (5 * WIDTH, 5 * HEIGHT)
    assert read_image(tmp_path / "a.HEIC", 5 * WIDTH, 5 * HEIGHT).any()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-be", "utf-32", "cp1252"])
def test_text_of_any_encoding(tmp_path, encoding):
    (tmp_path / "a.txt").write_bytes("höhe\r\nCafé 1\r\r\nenough of it to be told\r".encode(encoding))
    assert read_text(tmp_path / "a.txt") == "höhe\nCafé 1\nenough of it to be told\n"


@pytest.mark.parametrize(
    "content", [b"\xff\xfe\x80", b"SQLite format 3\0" + bytes(99), b"\x89PNG\r\n\x1a\n\0"]
)
def test_what_is_no_text_is_refused(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(DataError, match=r"a.txt: expected lines, found binary data \(.*\). Fetch"):
        read_text(tmp_path / "a.txt", "lines")
    with pytest.raises(DataError, match=r"b.txt: expected lines, found no such file"):
        read_text(tmp_path / "b.txt", "lines")


def test_json_with_backslashes_that_were_not_escaped(tmp_path):
    (tmp_path / "a.json").write_text(r'{"a": "images\000.png", "b": "c\\d", "e": "f\"g", "h": "i\test"}')
    assert read_json(tmp_path / "a.json") == {"a": r"images\000.png", "b": r"c\d", "e": 'f"g', "h": r"i\test"}


@pytest.mark.parametrize("side", [20_000, 30_000, 50_000])
def test_a_picture_that_says_it_is_huge_is_not_decoded(tmp_path, side):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    parts = (chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(bytes(1000))), chunk(b"IEND", b""))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    with pytest.raises(
        DataError, match=r"a.png: expected an image, found \d+ bytes that say they are far more"
    ):
        read_image(tmp_path / "a.png", 32, 24)


@pytest.mark.parametrize("text", ['{"a": ' + "9" * 5000 + "}", "[" * 100_000])
def test_json_that_is_too_long_or_too_deep(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=r"a.json: expected a JSON file, found bad JSON") as refused:
        read_json(tmp_path / "a.json")
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize("value", [[[1, 2], [3]], "x", None, [["a", "b", "c"]] * 3, [1, 2], 10**400])
def test_numbers_of_another_shape(tmp_path, value):
    with pytest.raises(DataError, match=r"a.json: expected K as 3x3 numbers, found"):
        as_numbers(tmp_path / "a.json", "K", value, (3, 3))


@pytest.mark.parametrize(
    ("name", "options"), [("a.png", {}), ("grey.png", {"transparency": 3}), ("a.gif", {})]
)
def test_pictures_are_decoded_without_touching_filters_of_warnings(tmp_path, monkeypatch, name, options):
    """Threads share the filters: one that restores filters saved by another silences all later warnings."""
    changes, catch = [], warnings.catch_warnings
    path = tmp_path / name
    shape = (4, 5) if options else (4, 5, 3)
    Image.fromarray(np.zeros(shape, np.uint8)).save(path, **options)
    monkeypatch.setattr(warnings, "catch_warnings", lambda: changes.append(1) or catch())
    assert read_image(path, 5, 4).shape == (4, 5, 3)
    assert not changes


def test_pictures_that_are_cut_off_are_named_without_decoding_them(tmp_path):
    contents = {name.replace(" ", ""): content for name, content in WHOLE.items()}
    contents |= {"largejpg": with_thumbnail(large(".jpg")), "largepng": large(".png")}
    assert min(len(contents["largejpg"]), len(contents["largepng"])) > 1.1 * 2**20
    files = []
    for name, content in contents.items():
        for cut in (False, True):
            files.append(tmp_path / f"{name}{cut:d}.jpg")
            files[-1].write_bytes(content[: int(0.9 * len(content))] if cut else content + b"film")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_truncated(tmp_path, [*files[::2], tmp_path / "none"])
    with pytest.warns(
        DataWarning,
        match=rf"{len(contents)} of {len(files)} pictures that were checked are cut off \(.*1.jpg",
    ):
        warn_of_truncated(tmp_path, files)
