"""Folders of numbered files of Gaussians."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.io.scenes import read_gaussians, write_gaussians
from gsjax.io.sequences import frame_files, missing_numbers
from tests.io.scenes_to_write import make_scene


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (("f10.ply", "f9.ply", "f9_labels.npz", ".f8.ply"), ("f9.ply", "f10.ply")),
        (("0001.compressed.ply", "0000.COMPRESSED.PLY"), ("0000.COMPRESSED.PLY", "0001.compressed.ply")),
        (("1.sog", "2.sog", "3/meta.json"), ("1.sog", "2.sog")),
        (("1.ply",), ()),
        (("1.ply", "2.ply", "notes.txt"), ("1.ply", "2.ply")),
        (("1.ply", "2.ply", "transforms.json"), ()),
        (("a1.ply", "b2.ply"), ()),
        (("1.ply", "2.spz"), ()),
        (("1.html", "2.html"), ()),
        (("a.ply", "b.ply"), ()),
    ],
)
def test_frames_of_a_folder(tmp_path, names, found):
    """A folder is one scene only if all of its files are its frames, or notes about them."""
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [file.name for file in frame_files(tmp_path)] == list(found)


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [((0, 1, 3), [2]), ((0, 10, 30, 40), [20]), ((7, 8, 9), []), ((1, 2, 90), []), ((0, 7, 17), [])],
)
def test_numbers_that_are_missing(numbers, missing):
    assert missing_numbers([Path(f"f_{number:03}.ply") for number in numbers]) == missing


def test_no_folder(tmp_path):
    assert frame_files(tmp_path / "none") == []


@pytest.mark.parametrize("ending", [".compressed.ply", ".sog"])
def test_rows_are_written_in_a_given_order(tmp_path, ending):
    scene, order = make_scene(20), np.random.default_rng(0).permutation(20)
    write_gaussians(tmp_path / f"a{ending}", scene, order=order)
    found = read_gaussians(tmp_path / f"a{ending}")[0].means
    np.testing.assert_allclose(found, scene.means[jnp.asarray(order)], atol=0.01)
    with pytest.raises(ValueError, match="order: expected 20 rows, as many as can be drawn, found 19"):
        write_gaussians(tmp_path / f"b{ending}", scene, order=order[:19])
