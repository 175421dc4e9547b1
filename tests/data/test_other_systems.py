"""Files as other systems and programs write them, which every reader accepts without a warning."""

import shutil
import warnings

import pytest

from gsjax.data import DataWarning
from tests.data.test_reader_errors import LAYOUTS

TEXT = (".txt", ".json", ".log")
PICTURES = (".png", ".jpg")
TRAILERS = {"padding": bytes(5000), "a film": b"\0\0\0\x18ftypmp42" + b"\xff\xd8\xff\0\x7f" * 400}


@pytest.fixture(params=LAYOUTS)
def layout(request, tmp_path):
    root = tmp_path / "freiburg3_DATA"
    root.mkdir()
    LAYOUTS[request.param].build(root)
    return root, LAYOUTS[request.param].read


def files(root, suffixes):
    return [path for path in root.rglob("*") if path.suffix in suffixes]


def read_silently(read, root):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        read(root)


@pytest.mark.thorough
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32"])
def test_text_in_any_encoding_with_any_line_ends(layout, encoding):
    root, read = layout
    if not (found := files(root, TEXT)):
        pytest.skip("no text in this layout")
    for path in found:
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode(encoding))
    read_silently(read, root)


@pytest.mark.thorough
@pytest.mark.parametrize("trailer", TRAILERS)
def test_pictures_with_bytes_behind_their_end(layout, trailer):
    root, read = layout
    if not (found := files(root, PICTURES)):
        pytest.skip("no pictures in this layout")
    for path in found:
        path.write_bytes(path.read_bytes() + TRAILERS[trailer])
    read_silently(read, root)


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["nerfstudio", "TUM RGB-D", "Panoptic"], indirect=True)
def test_names_with_backslashes(layout):
    root, read = layout
    for path in files(root, TEXT):
        text = path.read_text()
        for folder in ("images", "depth", "masks", "rgb", "cam0", "0", "1"):
            slash = "\\\\" if path.suffix == ".json" else "\\"
            text = text.replace(f"{folder}/", f"{folder}{slash}")
        path.write_text(text)
    read_silently(read, root)


@pytest.mark.parametrize("layout", ["TUM RGB-D", "7-Scenes", "Open3D RGB-D"], indirect=True)
@pytest.mark.parametrize("separator", [",", ";", "; ", "\t", ", "])
def test_numbers_with_other_separators(layout, separator):
    root, read = layout
    for path in files(root, TEXT):
        path.write_text(path.read_text().replace(" ", separator))
    read_silently(read, root)


def test_decimal_commas_between_semicolons(tmp_path):
    root = tmp_path / "freiburg3_DATA"
    root.mkdir()
    LAYOUTS["TUM RGB-D"].build(root)
    for name in ("rgb", "depth", "groundtruth"):
        path = root / f"{name}.txt"
        path.write_text(path.read_text().replace(".0 ", ",0 ").replace(" ", ";"))
    read_silently(LAYOUTS["TUM RGB-D"].read, root)


def test_a_copy_does_not_change_what_is_read(tmp_path):
    """File names may be absolute paths on the computer that wrote them."""
    root = tmp_path / "a"
    root.mkdir()
    LAYOUTS["nerfstudio"].build(root)
    path = root / "transforms.json"
    for place in ("C:\\\\Users\\\\me\\\\scan\\\\", "/home/me/scan/", "\\\\\\\\server\\\\scan\\\\"):
        moved = shutil.copytree(root, tmp_path / "b")
        (moved / "transforms.json").write_text(path.read_text().replace('"images/', f'"{place}images/'))
        read_silently(LAYOUTS["nerfstudio"].read, moved)
        shutil.rmtree(moved)
