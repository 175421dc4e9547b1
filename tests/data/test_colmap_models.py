"""Reconstructions as other programs write them, and several in one folder."""

import shutil

import numpy as np
import pytest

from gsjax.data import DataError, DataWarning, ReadOptions, open_photographs, read_colmap
from tests.data.test_colmap import build


def header_lines(text):
    return [line for line in text.splitlines() if line.endswith(".png")]


@pytest.mark.parametrize(
    "written",
    [
        lambda lines: "\n".join(lines),  # some exporters leave out the lines of points
        lambda lines: "\n".join(lines) + "\n\n\n",
        lambda lines: "# a\n" + "\n# between\n".join(lines) + "\n",
        lambda lines: "\n\n".join(lines),
        lambda lines: "\n\n\n".join(lines) + "\n",
        lambda lines: "\n\n1 2 -1\n\n".join(lines),
        lambda lines: f"{lines[0]}\n1.5 2 -1 3 4 17\n{lines[1]}\n{lines[2]}\n1 2 -1",
        lambda lines: "".join(f"{line}\n{'1.0 2.0 4 ' * 500}\n" for line in lines),
        lambda lines: "".join(f"  {line}  \r\n\r\n" for line in lines),
    ],
)
def test_lines_of_points_may_be_missing(tmp_path, written):
    build(tmp_path, "txt")
    truth = read_colmap(tmp_path)
    images = tmp_path / "sparse/0/images.txt"
    images.write_bytes(written(header_lines(images.read_text())).encode())
    scene = read_colmap(tmp_path)
    assert scene.names == truth.names
    np.testing.assert_array_equal(scene.viewmats, truth.viewmats)


@pytest.mark.parametrize("points", ["1 2", "1 2 3 4", "1 2 here", "1 2 3.5"])
def test_what_is_neither_a_photograph_nor_points_is_refused(tmp_path, points):
    build(tmp_path, "txt")
    images = tmp_path / "sparse/0/images.txt"
    images.write_text("\n".join(header_lines(images.read_text())) + f"\n{points}\n")
    with pytest.raises(DataError, match=r"images.txt, line 4: expected IMAGE_ID QW .*truncated"):
        read_colmap(tmp_path)


def test_names_of_windows(tmp_path):
    build(tmp_path, "txt")
    images = tmp_path / "sparse/0/images.txt"
    text = images.read_text().replace("day/b 2.png", "day\\b 2.png").replace(" a.png", " A.PNG")
    images.write_bytes(text.replace("\n", "\r\n").encode("utf-16"))
    scene = read_colmap(tmp_path)
    assert scene.names == ("A.PNG", "c.png", "day/b 2.png")
    assert scene.where("image", 2).endswith("day/b 2.png")


def with_photographs(root, count):
    """Keeps only the first `count` photographs of a reconstruction written as text."""
    images = root / "images.txt"
    images.write_text("\n\n".join(header_lines(images.read_text())[:count]) + "\n")


@pytest.mark.parametrize(("place", "forms"), [("sparse", ("txt", "bin")), ("colmap/sparse", ("txt", "txt"))])
def test_of_several_reconstructions_the_one_with_the_most_photographs_is_read(tmp_path, place, forms):
    for number, form in zip((0, 10, 2), (*forms, "txt"), strict=True):
        build(tmp_path, form, place=f"{place}/{number}")
    with_photographs(tmp_path / place / "0", 1)
    with_photographs(tmp_path / place / "2", 2)
    read = rf"of 3 reconstructions, {place}/10 with 3 photographs is read"
    said = rf"{read}; left out: {place}/0 \(1\), {place}/2 \(2\)"
    with pytest.warns(DataWarning, match=rf"{said}. Set model \(--read.model\) to read another"):
        assert open_photographs(tmp_path).num == 3
    for model in (f"{place}/2", *(["2"] if place == "sparse" else [])):
        assert open_photographs(tmp_path, ReadOptions(model=model)).num == 2
    with pytest.raises(
        DataError,
        match=rf"7: expected cameras.bin .*the reconstructions are: {place}/0, {place}/2, {place}/10",
    ):
        read_colmap(tmp_path, model=f"{place}/7")


def test_equal_and_unreadable_reconstructions(tmp_path):
    for place in ("sparse/0", "sparse/1", "sparse"):
        build(tmp_path, place=place)
    (tmp_path / "sparse/0/images.bin").write_bytes(b"\1")
    with pytest.warns(
        DataWarning, match=r"sparse/1 with 3 .*; left out: sparse/0 \(unreadable\), sparse \(3\)\. Set"
    ):
        assert read_colmap(tmp_path).num == 3


@pytest.mark.filterwarnings("error::gsjax.data.DataWarning")
def test_a_reconstruction_may_be_text_and_binary(tmp_path):
    build(tmp_path, "txt", place="both")
    build(tmp_path, "bin")
    truth = read_colmap(tmp_path)
    for name in ("cameras", "images", "points3D"):
        mixed = tmp_path / name
        shutil.copytree(tmp_path / "sparse", mixed / "sparse")
        shutil.copytree(tmp_path / "images", mixed / "images")
        (mixed / f"sparse/0/{name}.bin").unlink()
        shutil.copy(tmp_path / f"both/{name}.txt", mixed / "sparse/0")
        scene = read_colmap(mixed)
        np.testing.assert_allclose(scene.viewmats, truth.viewmats, atol=1e-12)
        assert len(scene.cloud.points) == len(truth.cloud.points)
