"""Screenshots of the viewer: where they are written, and that none overwrites another."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from gsjax.cli.view import screenshots


def test_screenshots_are_numbered_and_none_is_written_over(tmp_path):
    folder = tmp_path / "screenshots"
    save = screenshots(folder)
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 0] = 200
    assert save("render", red).name == "0001_render.png"
    (folder / "0007_view.png").write_bytes(b"mine")
    (folder / "notes.txt").touch()
    assert save("view", red).name == "0008_view.png"
    assert screenshots(folder)("render", 0 * red).name == "0009_render.png"
    np.testing.assert_array_equal(cv2.imread(str(folder / "0001_render.png"))[..., ::-1], red)
    assert (folder / "0007_view.png").read_bytes() == b"mine"


def test_a_number_that_another_took_meanwhile_is_left_to_it(tmp_path, monkeypatch):
    save = screenshots(tmp_path)
    listed = Path.iterdir

    def too_early(self):
        names = [*listed(self)]
        (self / "0001_render.png").write_bytes(b"theirs")
        return iter(names)

    monkeypatch.setattr(Path, "iterdir", too_early)
    assert save("render", np.zeros((4, 6, 3), np.uint8)).name == "0002_render.png"
    assert (tmp_path / "0001_render.png").read_bytes() == b"theirs"


def test_a_screenshot_that_fails_leaves_nothing(tmp_path, monkeypatch):
    def full(path, picture):
        raise OSError("no space")

    monkeypatch.setattr("gsjax.cli.view.write_png", full)
    with pytest.raises(OSError, match="no space"):
        screenshots(tmp_path)("render", np.zeros((4, 6, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
