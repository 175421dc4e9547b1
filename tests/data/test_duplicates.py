"""Photographs that a dataset lists twice."""

import json
import os
import shutil
import tracemalloc
import warnings

import numpy as np
import pytest

from gsjax.data import DataWarning, Photographs, open_photographs
from gsjax.data.duplicates import without_duplicates
from tests.data import dots
from tests.data.faulty import moved, picture

COUNT = 4


def write(root, names, places, name="transforms.json", **more):
    frames = [
        {"file_path": file, "transform_matrix": moved(x).tolist()}
        for file, x in zip(names, places, strict=True)
    ]
    (root / name).write_text(json.dumps({"fl_x": 30.0, "frames": frames} | more))


@pytest.fixture
def folder(tmp_path):
    for i in range(COUNT):
        dots.save(tmp_path / f"images/{i}.png", picture(i))
    return tmp_path


NAMES = [f"images/{i}.png" for i in range(COUNT)]
PLACES = [float(i) for i in range(COUNT)]


@pytest.mark.parametrize(
    "twin", ["images/1.png", "./images/1.png", "images/../images/1.png", "copy.png", "link"]
)
@pytest.mark.parametrize("off", [0.0, 0.003])
def test_one_of_each_is_used(folder, twin, off):
    if twin == "copy.png":
        shutil.copy(folder / NAMES[1], folder / twin)
    if twin == "link":
        os.symlink(folder / NAMES[1], folder / twin)
    write(folder, [*NAMES, twin], [*PLACES, 1 + off])
    with pytest.warns(DataWarning, match=r"1 of 5 photographs are listed twice \(.*\): one of each is used"):
        scene = open_photographs(folder)
    assert scene.names == tuple(NAMES)
    np.testing.assert_array_equal(scene.image(1), picture(1))
    np.testing.assert_allclose(np.linalg.inv(scene.viewmats[:, :3, :3])[0], np.diag([1, -1, -1]))


def test_the_held_out_one_stays(folder):
    shutil.copy(folder / NAMES[0], folder / "copy.png")
    splits = {"train_filenames": NAMES, "test_filenames": ["copy.png"]}
    write(folder, [*NAMES, "copy.png"], [*PLACES, 0.0], **splits)
    with pytest.warns(DataWarning, match=r"listed twice \(images/0.png\)"):
        scene = open_photographs(folder)
    assert scene.names == (*NAMES[1:], "copy.png")
    assert scene.splits == ("train",) * 3 + ("test",)


def test_splits_in_files_of_their_own(folder):
    write(folder, NAMES[:3], PLACES[:3], "transforms_train.json")
    write(folder, NAMES[2:], PLACES[2:], "transforms_test.json")
    with pytest.warns(DataWarning, match=r"1 of 5 photographs are listed twice"):
        scene = open_photographs(folder)
    assert scene.splits == ("train", "train", "test", "test")


def test_equal_pictures_from_other_places_or_times_are_kept(folder):
    """A scene of one colour looks the same from everywhere, and a static scene at all times."""
    for i in range(COUNT):
        dots.save(folder / NAMES[i], picture(0))
    write(folder, NAMES, PLACES)
    frames = json.loads((folder / "transforms.json").read_text())
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        assert open_photographs(folder).num == COUNT
        for i, frame in enumerate(frames["frames"]):
            frame |= {"time": i / COUNT, "transform_matrix": np.eye(4).tolist()}
        (folder / "transforms.json").write_text(json.dumps(frames))
        assert open_photographs(folder).num == COUNT


def test_memory_grows_with_the_number_of_photographs(tmp_path):
    """All files have one size, as from cameras without compression, so all could be duplicates."""
    num = 1500
    for i in range(num):
        (tmp_path / f"{i}").write_bytes(i.to_bytes(4, "little"))
    scene = Photographs(
        name="many",
        names=tuple(map(str, range(num))),
        sizes=np.full((num, 2), 8),
        Ks=np.tile(np.eye(3), (num, 1, 1)),
        viewmats=np.tile(np.eye(4), (num, 1, 1)),
        load_image=lambda i: picture(i),
        locate=lambda kind, i: str(tmp_path / f"{i}"),
    )
    tracemalloc.start()
    assert without_duplicates(scene) is scene
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * num**2


def test_other_layouts(folder):
    rows = [f"{i + 1} 1 0 0 0 {-x} 0 0 1 {i % COUNT}.png\n\n" for i, x in enumerate([*PLACES, 0.0])]
    (folder / "cameras.txt").write_text("1 SIMPLE_PINHOLE 32 24 30 16 12\n")
    (folder / "images.txt").write_text("".join(rows))
    with pytest.warns(DataWarning, match=r"1 of 5 photographs are listed twice \(0.png\)"):
        assert open_photographs(folder).num == COUNT
