"""`gsjax info` on photographs; on recordings see test_main."""

import cv2
import numpy as np

from gsjax.cli import main


def test_photographs_are_described_and_what_is_missing_is_counted(photographs, capfd):
    assert main(["info", str(photographs)]) == 0
    out, err = capfd.readouterr()
    assert "9: images/00.png to images/22.png" in out
    assert "48 x 36" in out
    assert "points" in out
    assert "of 10 listed photographs 1 that have no file" in err


def test_what_a_layout_leaves_open_is_asked_for_and_taken(tmp_path, capfd):
    matrix = np.column_stack([np.eye(3), np.zeros(3), [36, 48, 50]])  # right, up, back
    rows = np.tile([*matrix.ravel(), 0.1, 10.0], (2, 1))
    np.save(tmp_path / "poses_bounds.npy", rows)
    (tmp_path / "images").mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((36, 48, 3), 40 * i, np.uint8))
    assert main(["info", str(tmp_path)]) == 2
    assert "give axes (--read.axes), llff" in capfd.readouterr().err
    assert main(["info", str(tmp_path), "--read.axes", "endonerf"]) == 0
    out, _ = capfd.readouterr()
    assert "2: 0.png to 1.png" in out
    assert "51° wide" in out
