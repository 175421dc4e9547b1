"""Files found by the names that datasets give them."""

import os

import pytest

from gsjax.data.names import find_file, portable

COMPOSED, DECOMPOSED = "caf\u00e9.png", "cafe\u0301.png"


@pytest.fixture
def folder(tmp_path):
    for name in (
        "images/Frame_1.PNG",
        "images/frame 2.jpg",
        f"images/{DECOMPOSED}",
        "a.png",
        "A.png",
        "b/a.png",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("images/Frame_1.PNG", "images/Frame_1.PNG"),
        ("./images//Frame_1.PNG", "images/Frame_1.PNG"),
        ("images\\Frame_1.PNG", "images/Frame_1.PNG"),
        (".\\Images\\frame_1.png", "images/Frame_1.PNG"),
        ("images/frame_1", "images/Frame_1.PNG"),
        ("images\frame 2", "images/frame 2.jpg"),
        ("images/frame 2.jpg ", "images/frame 2.jpg"),
        ("D:\\scans\\images\\frame 2.jpg", "images/frame 2.jpg"),
        ("/home/me/scan/images/frame 2.jpg", "images/frame 2.jpg"),
        (f"images/{COMPOSED}", f"images/{DECOMPOSED}"),
        ("b/../images/FRAME 2.jpg", "b/../images/frame 2.jpg"),
        ("A.png", "A.png"),
        ("a.PNG", None),  # ambiguous: a.png or A.png
        ("images/gone.png", None),
        ("images", None),
        ("elsewhere/Frame_1.PNG", None),
        ("frame 2.jpg", None),
        ("..", None),
        ("", None),
        ("\0", None),
        ("x" * 5000, None),
    ],
)
def test_a_name_finds_its_file(folder, name, file):
    found = find_file(folder, name, (".png", ".jpg"))
    assert (found and os.path.normpath(found)) == (file and os.path.normpath(folder / file))


def test_names_are_written_with_slashes():
    assert portable("a\\b\\frame.png") == "a/b/frame.png"
    assert portable("images\frame.png") == "images/frame.png"
