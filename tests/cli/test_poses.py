"""`gsjax poses`: from pictures without poses to a dataset that `gsjax fit` opens."""

import json
import shlex
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsjax.cli import main
from gsjax.data import open_photographs
from gsjax.data.alignment import align_cameras
from gsjax.data.structure_from_motion import SfmResult
from gsjax.engine import poses
from gsjax.io.video import VideoWriter
from tests.data import dots, room

pytest.importorskip("pycolmap")

COUNT = 6


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Pictures of the room, and one of something else."""
    folder = tmp_path_factory.mktemp("room") / "photos"
    room.write(folder, COUNT)
    dots.save(folder / "else.png", room.picture(room.viewmats(1)[0])[::-1, ::-1, ::-1] // 7)
    return folder


@pytest.fixture(scope="module")
def found(photographs, tmp_path_factory):
    """The dataset that is made from `photographs`."""
    out = tmp_path_factory.mktemp("found") / "dataset"
    assert main(["poses", str(photographs), "--out", str(out)]) == 0
    return out


@pytest.fixture
def say(capfd):
    def call(*arguments) -> tuple[int, str]:
        code = main(["poses", *map(str, arguments)])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err

    return call


@pytest.mark.thorough
def test_cameras_are_where_the_pictures_were_drawn_from(found):
    scene = open_photographs(found)
    assert scene.names == tuple(f"{i}.png" for i in range(COUNT))
    aligned = align_cameras(scene.viewmats, room.viewmats(COUNT))
    assert aligned.turned_deg.max() < 0.2
    assert aligned.moved.max() < 0.005 * aligned.extent
    np.testing.assert_allclose(scene.Ks[:, 0, 0], room.FOCAL, rtol=0.01)
    assert len(scene.cloud.points) > 500
    floor_and_walls = aligned.scale * scene.cloud.points @ aligned.rotation.T + aligned.translation
    off = np.abs(floor_and_walls - [1, 1, 0]).min(axis=1)
    assert np.quantile(off, 0.9) < 0.01
    assert scene.image(0).shape == (room.HEIGHT, room.WIDTH, 3)


@pytest.mark.thorough
def test_the_report_says_what_was_found_and_what_was_left(found):
    report = json.loads((found / "poses.json").read_text())
    assert (report["photographs"], report["registered"]) == (COUNT + 1, COUNT)
    assert (report["left_out"], report["other_models"]) == (["else.png"], [])
    assert 0 < report["error_px"] < 0.5
    assert report["points"] > 500
    assert report["pairs"] >= COUNT - 1
    assert set(report["seconds"]) == {"features", "matching", "mapping", "total"}
    assert sorted(path.name for path in found.iterdir()) == ["images", "poses.json", "sparse"]
    assert len(list((found / "images").iterdir())) == COUNT + 1


@pytest.mark.thorough
def test_again_gives_the_same_bits_and_compares(found, photographs, say, tmp_path):
    """In place this time: the photographs stay where they are."""
    folder = tmp_path / "my data/images"
    shutil.copytree(photographs, folder)
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    code, said = say(folder, "--out", folder.parent, "--compare", found)
    assert code == 0, said
    assert f"Next: gsjax fit {shlex.quote(str(folder.parent))} --out RUN" in said
    assert f"{COUNT} of {COUNT + 1} photographs" in said
    assert "1: else.png" in said
    assert f"with {COUNT} of dataset: turned by 0.000°" in " ".join(said.split())
    for name in ("cameras", "images", "points3D"):
        files = [root / f"sparse/0/{name}.bin" for root in (found, folder.parent)]
        assert files[0].read_bytes() == files[1].read_bytes()
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before
    compared = json.loads((folder.parent / "poses.json").read_text())["compared"]
    assert compared["photographs"] == COUNT
    assert compared["focal_ratio"] == 1


@pytest.mark.slow
def test_a_video(say, tmp_path):
    with VideoWriter(tmp_path / "walk.mp4", 10, quality=8) as video:
        for viewmat in room.viewmats(18):
            video.write(room.picture(viewmat))
    code, said = say(
        tmp_path / "walk.mp4", "--out", tmp_path / "out", "--stills", "9", "--compare", "nothing"
    )
    assert code == 2, said
    code, said = say(tmp_path / "walk.mp4", "--out", tmp_path / "out", "--stills", "9")
    assert code == 0, said
    assert "matching neighbours" in said
    scene = open_photographs(tmp_path / "out")
    assert scene.num >= 8
    truth = room.viewmats(18)[[int(name[6:12]) for name in scene.names]]
    aligned = align_cameras(scene.viewmats, truth)
    assert aligned.turned_deg.max() < 1
    assert aligned.moved.max() < 0.02 * aligned.extent


@pytest.mark.thorough
def test_pictures_in_formats_that_colmap_lacks(say, photographs, tmp_path):
    """They are read like any other, whatever their extension, and copied unchanged."""
    folder, out = tmp_path / "photos", tmp_path / "out"
    shutil.copytree(photographs, folder)
    for name, suffix in (("0", ".webp"), ("1", ".png")):
        with Image.open(folder / f"{name}.png") as picture:
            picture.load()
        (folder / f"{name}.png").unlink()
        picture.save(folder / f"{name}{suffix}", "WEBP", lossless=True)
    code, said = say(folder, "--out", out)
    assert code == 0, said
    assert open_photographs(out).names == ("0.webp", *(f"{i}.png" for i in range(1, COUNT)))
    assert (out / "images/0.webp").read_bytes() == (folder / "0.webp").read_bytes()


def test_folders_that_cannot_be_used(say, tmp_path):
    (tmp_path / "empty").mkdir()
    out = tmp_path / "new/out"
    code, said = say(tmp_path / "empty", "--out", out)
    assert code == 2
    assert "empty: expected 3 photographs or more (.png, .jpg, " in said
    assert "found none. Give the folder that holds them." in said
    dots.save(tmp_path / "empty/a.png", np.zeros((20, 20, 3), np.uint8))
    (tmp_path / "empty/b.jpg").write_bytes(b"no picture")
    assert "found 1, and 1 that cannot be read" in say(tmp_path / "empty", "--out", out)[1]
    assert (
        "nowhere: expected a folder of photographs or a video" in say(tmp_path / "nowhere", "--out", out)[1]
    )
    assert "b.jpg: expected a video" in say(tmp_path / "empty/b.jpg", "--out", out)[1]
    (tmp_path / "phone").mkdir()
    for name in ("1.HEIC", "2.heic"):
        (tmp_path / "phone" / name).write_bytes(b"")
    said = say(tmp_path / "phone", "--out", out)[1]
    assert "phone: expected 3 photographs or more" in said
    assert "found 2 in a format that is not read (HEIC: " in said
    assert "Convert to JPEG or PNG first" in said
    dots.save(tmp_path / "phone/a.png", np.zeros((20, 20, 3), np.uint8))
    assert "of 3 pictures, 2 in a format that is not read" in say(tmp_path / "phone", "--out", out)[1]
    assert not (tmp_path / "new").exists()
    said = say(tmp_path / "empty", "--out", tmp_path / "empty")[1]
    assert "the photographs themselves are there; name another folder" in said


def test_pictures_without_texture_and_one_that_cannot_be_read(say, tmp_path):
    room.write(tmp_path / "plain", 4, plain=True)
    content = (tmp_path / "plain/3.png").read_bytes()
    (tmp_path / "plain/3.png").write_bytes(content[: len(content) // 2])
    code, said = say(tmp_path / "plain", "--out", tmp_path / "out")
    assert code == 2
    assert "1 of 4 photographs cannot be read and are left out: " in said
    assert "3.png: expected an image, found a file that is cut off" in said
    expected = "expected photographs that can be registered together, found 0 pairs with verified matches"
    assert expected in said
    assert "Take more photographs with more overlap" in said
    assert not (tmp_path / "out").exists()


def test_what_stands_in_the_way_is_not_replaced(say, tmp_path, photographs):
    (tmp_path / "theirs/sparse").mkdir(parents=True)
    code, said = say(photographs, "--out", tmp_path / "theirs", "--overwrite")
    assert code == 2
    assert "expected a folder without images and sparse, found sparse that gsjax poses did not write" in said
    (tmp_path / "theirs/poses.json").touch()
    assert "--overwrite replaces it" in say(photographs, "--out", tmp_path / "theirs")[1]
    assert "expected a folder, found a file" in say(photographs, "--out", tmp_path / "theirs/poses.json")[1]


@pytest.fixture
def unplaced(monkeypatch):
    """Skips COLMAP: `gsjax poses` only checks its folders, copies the photographs, and writes an empty
    model."""
    model = SimpleNamespace(
        cameras={1: SimpleNamespace(width=4, height=4, params=[1.0, 2.0, 2.0])},
        write_binary=lambda folder: None,
        num_points3D=lambda: 0,
        compute_mean_track_length=lambda: 0.0,
    )
    result = SfmResult(model, (), (), (), {"a.png": 1}, 0, 0.0, {})
    monkeypatch.setattr(poses, "reconstruct_cameras", lambda *a, **k: result)
    monkeypatch.setattr(poses, "read_colmap", lambda folder: None)


def squares(folder, shade):
    """Writes three photographs; returns their contents."""
    for i in range(3):
        dots.save(folder / f"{i}.png", np.full((4, 4, 3), shade, np.uint8))
    return contents(folder)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_photographs_that_were_used_in_place_are_never_replaced(unplaced, say, tmp_path):
    mine = tmp_path / "mine/images"
    before, others = squares(mine, 0), squares(tmp_path / "others", 200)
    for more in ((), ("--overwrite",)):
        assert say(mine, "--out", mine.parent, *more)[0] == 0
    for more in (("--overwrite",), ()):
        code, said = say(tmp_path / "others", "--out", mine.parent, *more)
        assert contents(mine) == before
        assert code == 2
        assert "images: expected copies made by gsjax poses, and poses.json does not say" in said
    out = tmp_path / "out"
    squares(tmp_path / "first", 100)
    assert say(tmp_path / "first", "--out", out)[0] == 0
    (out / "images").rename(tmp_path / "disk")
    (out / "images").symlink_to(tmp_path / "disk")
    copies = contents(tmp_path / "disk")
    assert say(tmp_path / "others", "--out", out, "--overwrite")[0] == 0
    assert contents(out / "images") == others
    assert contents(tmp_path / "disk") == copies  # only the link was replaced
    (out / "images").rename(tmp_path / "more")
    (out / "images").symlink_to(tmp_path / "gone")
    assert say(tmp_path / "others", "--out", out, "--overwrite")[0] == 0
    assert contents(out / "images") == others


def test_a_folder_among_the_photographs_is_refused(unplaced, say, tmp_path):
    """Copies that an earlier run put there would be found with the photographs."""
    squares(tmp_path / "photos", 0)
    code, said = say(tmp_path / "photos", "--out", tmp_path / "photos/new/out")
    assert code == 2
    assert "new/out: expected a folder outside" in said
    assert not (tmp_path / "photos/new").exists()


def test_names_that_repeat_in_subfolders_are_told_apart():
    names = tuple(f"{side}/{i}.png" for side in ("left", "right") for i in range(3))
    rig = replace(
        open_photographs("simulated:tabletop?frames=6&width=32&height=24").select(range(6)), names=names
    )
    assert poses._in_both(names, rig) == [(i, i) for i in range(6)]
    assert poses._in_both([f"images/{i}.png" for i in (2, 1, 0)], rig.select(range(3))) == [
        (0, 2),
        (1, 1),
        (2, 0),
    ]
    below = replace(rig, names=tuple(f"images/{name}" for name in reversed(names)))
    assert poses._in_both(names, below) == [(i, 5 - i) for i in range(6)]
    with pytest.raises(ValueError, match="found 0 of the same name"):
        poses._in_both([f"{i}.png" for i in range(3)], rig)


def test_names_that_are_not_in_the_other_dataset(say, tmp_path, photographs):
    code, said = say(
        photographs, "--out", tmp_path / "out", "--compare", "simulated:tabletop?frames=2&width=32&height=24"
    )
    assert code == 2
    assert (
        "--compare: expected poses of three of these photographs or more in tabletop_seed0, found 0" in said
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("option", "value", "says"),
    [
        ("max-size", "10", "max_size: expected 64 or more, found 10"),
        ("overlap", "0", "overlap: expected 1 or more, found 0"),
        ("mapping-threads", "0", "mapping_threads: expected 1 or more, or -1, found 0"),
    ],
)
def test_settings_without_a_meaning(say, photographs, tmp_path, option, value, says):
    code, said = say(photographs, "--out", tmp_path / "out", f"--{option}", value)
    assert code == 2
    assert says in said


def test_without_pycolmap(say, tmp_path, photographs, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    code, said = say(photographs, "--out", tmp_path / "out")
    assert code == 2
    assert "gsjax poses needs pycolmap, which is not installed: " in said
    assert f"{sys.executable} -m pip install 'gsjax[poses]'" in said
