"""`gsjax info` on photographs, runs and files of Gaussians; for recordings see test_main."""

import json
import shutil
from dataclasses import replace

import cv2
import equinox as eqx
import numpy as np
import pytest

import gsjax
from gsjax.cli import main
from gsjax.data import DataWarning, Photographs, open_photographs, open_sequence, photographs_of
from gsjax.data.origin import relative_to_origin
from gsjax.data.photographs import Cloud
from gsjax.engine.info_picture import by_camera, by_split, scene_points, write_picture
from gsjax.engine.info_scene import describe_scene
from gsjax.io.ply import write_ply
from gsjax.io.scenes import write_gaussians
from gsjax.viz.cameras import cameras_and_points
from tests.cli.compare.made_up_runs import write_run
from tests.io.scenes_to_write import make_scene


def told(path, capfd) -> tuple[str, str]:
    """What `gsjax info` says on stdout, and on stderr, as one line each."""
    assert main(["info", str(path)]) == 0
    out, err = capfd.readouterr()
    return " ".join(out.split()), " ".join(err.split())


@pytest.mark.thorough
def test_photographs_are_described_and_what_is_missing_is_counted(photographs, capfd):
    assert main(["info", str(photographs)]) == 0
    out, err = capfd.readouterr()
    assert "9: images/00.png to images/22.png" in out
    assert "48 x 36" in out
    assert "points" in out
    assert "of 10 listed photographs, 1 with no file" in err


def test_what_a_layout_leaves_open_is_asked_for_and_taken(tmp_path, capfd):
    matrix = np.column_stack([np.eye(3), np.zeros(3), [36, 48, 50]])  # right, up, back
    rows = np.tile([*matrix.ravel(), 0.1, 10.0], (2, 1))
    np.save(tmp_path / "poses_bounds.npy", rows)
    (tmp_path / "images").mkdir()
    for i in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), np.full((36, 48, 3), 40 * i, np.uint8))
    assert main(["info", str(tmp_path)]) == 2
    assert "set axes (--read.axes) to llff" in capfd.readouterr().err
    assert main(["info", str(tmp_path), "--read.axes", "endonerf"]) == 0
    out, _ = capfd.readouterr()
    assert "2: 0.png to 1.png" in out
    assert "51° wide" in out


@pytest.mark.thorough
def test_a_picture_shows_what_becomes_of_each_photograph(photographs, capfd, tmp_path, monkeypatch):
    drawn = {}

    def draw(groups, points, colors, **words):
        drawn.update(groups=groups, points=points, **words)
        return cameras_and_points(groups, points, colors, **words)

    monkeypatch.setattr("gsjax.viz.cameras.cameras_and_points", draw)
    path = tmp_path / "deep/scene.png"
    assert main(["info", str(photographs), "--picture", str(path)]) == 0
    assert f"wrote {path}" in capfd.readouterr().out
    assert cv2.imread(str(path)).shape[1] > 1000
    assert list(path.parent.iterdir()) == [path]
    counts = {name: len(group.viewmats) for name, group in drawn["groups"].items()}
    assert counts == {"fitted": 7, "held out": 2}
    assert drawn["points"] is None
    assert drawn["unit"] == "units of the data"


def test_a_picture_is_in_the_coordinates_of_the_data(photographs, tmp_path, monkeypatch):
    drawn = {}

    def draw(groups, points, colors, **words):
        drawn.update(groups=groups, points=points)
        return cameras_and_points(groups, points, colors, **words)

    monkeypatch.setattr("gsjax.viz.cameras.cameras_and_points", draw)
    with pytest.warns(DataWarning):
        data = open_photographs(photographs)
    cloud = Cloud(np.eye(3), np.zeros((3, 3)))
    moved = relative_to_origin(replace(data, cloud=cloud), np.array([500_000.0, 5_000_000.0, 300.0]))
    write_picture(tmp_path / "a.svg", moved, {"all": np.arange(data.num)})
    np.testing.assert_allclose(drawn["groups"]["all"].viewmats, data.viewmats, atol=1e-6)
    np.testing.assert_allclose(drawn["points"], np.eye(3), atol=1e-6)


def test_the_split_of_the_data_is_shown_too(photographs, tmp_path, monkeypatch):
    meta = json.loads((photographs / "transforms.json").read_text())
    names = [frame["file_path"] for frame in meta["frames"]]
    meta |= {"train_filenames": names[:5], "val_filenames": names[5:7], "test_filenames": names[7:]}
    folder = tmp_path / "table"
    shutil.copytree(photographs, folder)
    (folder / "transforms.json").write_text(json.dumps(meta))
    with pytest.warns(DataWarning):
        groups = by_split(open_photographs(folder))
    assert {name: indices.tolist() for name, indices in groups.items()} == {
        "fitted": [0, 1, 2, 3, 4],
        "held out": [7, 8],
        "not used": [5, 6],
    }


def test_masks_that_are_not_there_are_not_asked_for(recording, capfd):
    """Only a camera with a mask is named, as `gsjax track --mask-camera` needs one."""
    for camera in ("0", "2"):
        (recording / "seg" / camera / "000000.png").unlink()
    assert main(["info", str(recording)]) == 0
    out, _ = capfd.readouterr()
    assert "camera 1, labels 1, 2, 3, 4, 5 in the first frame" in " ".join(out.split())


@pytest.mark.thorough
def test_a_recording_is_drawn_by_camera_with_points_of_its_depth(capfd, tmp_path):
    sequence = open_sequence("simulated:tabletop?frames=4&width=48&height=36")
    groups = by_camera(sequence)
    scene = photographs_of(sequence)
    assert list(groups) == ["camera 0", "camera 1", "camera 2"]
    for c, indices in enumerate(groups.values()):
        np.testing.assert_array_equal(scene.viewmats[indices], sequence.viewmats[:, c])
    points, colors = scene_points(scene)
    assert points.shape == colors.shape
    on_table = np.abs(points[:, 2]) < 0.002  # whose top is at height 0
    assert 0.2 < on_table.mean() < 1
    code = main(
        ["info", "simulated:tabletop?frames=2&width=48&height=36", "--picture", str(tmp_path / "a.svg")]
    )
    assert code == 0
    text = (tmp_path / "a.svg").read_text()
    assert "camera 2 (2)" in text
    assert "z (m)" in text


def test_points_of_a_fisheye_lie_at_their_distances():
    scene = Photographs(
        "a shell around the lens",
        ("a.png",),
        np.array([[40, 30]]),
        np.array([[[15.0, 0, 20], [0, 15.0, 15], [0, 0, 1]]]),
        np.eye(4)[None],
        load_image=lambda i: np.zeros((30, 40, 3), np.uint8),
        load_depth=lambda i: np.full((30, 40), 2.0, np.float32),
        fisheye=np.zeros((1, 4)),
    )
    points, _ = scene_points(scene)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.0, rtol=1e-5)


def test_a_run_of_live_is_told_by_how_it_kept_up(capfd, tmp_path):
    found = {"kind": "live", "source": "table", "stopped": None, "frames": {"used": 179, "offered": 180}}
    found |= {"hz": 14.94, "latency_ms": {"median": 55.1, "p95": 73.0}, "frames_lost": {"can": 3, "ball": 0}}
    (tmp_path / "config.yml").write_text("# gsjax run\nsource: table\n")
    (tmp_path / "metrics.json").write_text(json.dumps(found))
    said, _ = told(tmp_path, capfd)
    assert "run gsjax live, finished source table frames 179 of 180, 14.94 Hz" in said
    assert "latency median 55 ms, 95 % below 73 ms" in said
    assert "lost can in 3 frames" in said
    (tmp_path / "metrics.json").write_text(json.dumps({"kind": "live"}))
    assert main(["info", str(tmp_path)]) == 2
    said = " ".join(capfd.readouterr().err.split())
    assert "metrics.json: expected the scores of gsjax live, found others" in said


@pytest.mark.parametrize("kind", ["parts", "distill", "deform"])
def test_a_run_is_told_by_its_end_its_data_its_scores_and_its_scene(kind, capfd, tmp_path):
    data = {"scene" if kind == "distill" else "dataset": "data/room"}
    run = write_run(tmp_path / "run", kind, 20.0, **data)
    write_ply(run / "scene.ply", make_scene(30))
    (run / "report.html").touch()
    said, _ = told(run, capfd)
    assert f"run gsjax {kind}, finished dataset made up at 96x72, " in said
    assert "file PLY of 3DGS, " in said
    assert "Gaussians 30" in said
    assert said.replace(" ", "").endswith(f"report{run / 'report.html'}")
    if kind == "parts":
        assert "19.00 dB" in said  # held out
    (run / "scene.ply").write_bytes((run / "scene.ply").read_bytes()[:900])
    said, warned = told(run, capfd)
    assert "run gsjax" in said
    assert "one that cannot be parsed" in warned


def test_a_file_of_a_run_is_told(capfd, tmp_path):
    run = write_run(tmp_path / "run", "deform", 20.0, dataset="data/room")
    assert main(["info", str(run / "metrics.json")]) == 2
    assert f"found a file of a run; give its folder, {run}" in " ".join(capfd.readouterr().err.split())
    (run / "transforms.json").write_text('{"frames": []}')  # a dataset that happens to lie there
    assert main(["info", str(run / "transforms.json")]) == 2
    assert "expected frames, a non-empty list" in " ".join(capfd.readouterr().err.split())


def test_pictures_that_are_cut_off_are_told(photographs, capfd, tmp_path):
    shutil.copytree(photographs, tmp_path / "cut")
    picture = tmp_path / "cut/images/02.png"
    picture.write_bytes(picture.read_bytes()[:-40])
    assert main(["info", str(tmp_path / "cut")]) == 0
    assert "1 of 9 pictures that were checked are cut off (" in " ".join(capfd.readouterr().err.split())


def test_a_run_that_is_not_finished_is_told(capfd, tmp_path):
    run = write_run(tmp_path / "run", "deform", 20.0, dataset="data/room")
    assert "gsjax deform, still going on, or killed; run it again" in told(run, capfd)[0]  # without a report
    (run / "resume").mkdir()
    (run / "resume" / "state.npz").touch()
    found = json.loads((run / "metrics.json").read_text()) | {"complete": False, "stopped": "SIGTERM"}
    (run / "metrics.json").write_text(json.dumps(found))
    assert "stopped by SIGTERM; continue it with --resume" in told(run, capfd)[0]
    (run / "metrics.json").unlink()
    said, _ = told(run, capfd)
    assert "still going on, or killed; continue it with --resume dataset data/room" in said


@pytest.mark.parametrize(
    ("key", "value"),
    [("size", 5), ("size", []), ("frames", {}), ("seconds", 5), ("test", None), ("size", None)],
)
def test_scores_of_another_type_are_refused_by_file(key, value, capfd, tmp_path):
    run = write_run(tmp_path / "run", "deform", 20.0, dataset="data/room")
    found = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps(found | {key: value}))
    code = main(["info", str(run)])
    said = " ".join(capfd.readouterr().err.split())
    assert (code, "a fault of gsjax" in said) in ((0, False), (2, False)), said
    assert code == 0 or "metrics.json: expected the scores of gsjax deform, found others" in said


def test_a_run_without_scores_is_told_with_its_scene(capfd, tmp_path):
    (tmp_path / "config.yml").write_text("# gsjax run\nsource: camera:0\n")
    write_ply(tmp_path / "scene.ply", make_scene(30))
    said, _ = told(tmp_path, capfd)
    assert "scores are not listed here" in said
    assert "Gaussians 30" in said


def test_what_is_about_datasets_alone_is_refused_for_scenes_and_runs(capfd, tmp_path):
    write_ply(tmp_path / "scene.ply", make_scene(30))
    for option, says in (
        (("--picture", "run.png"), "--picture: draws the cameras of a dataset, found none in"),
        (("--read.images", "pictures"), "--read: is about datasets, and"),
    ):
        assert main(["info", str(tmp_path / "scene.ply"), *option]) == 2
        assert says in " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.glb", b"glTF\2\0\0\0", "found glTF, which is only written"),
        ("p.jpg", b"\xff\xd8\xff\xe0", "found a JPEG picture"),
        ("nothing.ply", None, "expected a dataset, a run or a file of Gaussians, found nothing there"),
        ("meta.json", b'{"frames": []}', "meta.json: expected frames, a non-empty list"),
    ],
)
def test_what_it_is_not_is_told(name, content, says, capfd, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert main(["info", str(tmp_path / name)]) == 2
    assert says in " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ("ending", "told"),
    [
        (".ply", "PLY of 3DGS, "),
        (".compressed.ply", "PlayCanvas's compressed PLY, "),
        (".splat", ".splat, "),
        (".spz", "SPZ 3, "),
        (".sog", "SOG 2, "),
    ],
)
def test_a_file_is_told_by_its_format_and_what_is_odd_about_it(ending, told, capfd, tmp_path):
    scene = make_scene(30, 0)
    scene = eqx.tree_at(lambda g: g.logit_opacities, scene, scene.logit_opacities.at[:3].set(-7.0))
    write_gaussians(tmp_path / f"scene{ending}", scene)
    assert main(["info", str(tmp_path / f"scene{ending}")]) == 0
    said = " ".join(capfd.readouterr().out.split())
    assert f"file {told}" in said
    if ending == ".sog":
        shutil.unpack_archive(tmp_path / "scene.sog", tmp_path / "scene", "zip")
        size = sum(file.stat().st_size for file in (tmp_path / "scene").iterdir())
        for path in (tmp_path / "scene", tmp_path / "scene" / "meta.json"):
            assert main(["info", str(path)]) == 0
            assert f"SOG 2, {size / 1e3:.1f} kB" in capfd.readouterr().out
            assert gsjax.open_scene(path).gaussians.num == 30
    assert "3 are too faint to be drawn" in said


def test_pictures_of_another_kind_are_refused_before_anything_is_read(capfd):
    assert main(["info", "nowhere", "--picture", "scene.bmp"]) == 2
    said = capfd.readouterr().err
    assert "--picture: expected a name that ends in .png, .svg, .pdf, found 'scene.bmp'" in said


def test_a_recording_that_is_also_photographs_is_told_as_what_it_is_over_time(shared_data, capfd):
    """EndoNeRF's folders have poses_bounds.npy as LLFF's do."""
    assert main(["info", str(shared_data / "tissue_0")]) == 0
    out = capfd.readouterr().out
    assert "60" in out
    assert "tracks of 784 points" in out


@pytest.mark.parametrize(
    ("labels", "words"),
    [
        (range(30), "0 to 29"),
        ([0, 4], "0, 4"),
        ([*range(0, 40, 2), *range(10)], "0, 1, 2, 3, 4, 5, 6, 7, ... (25 in all)"),
    ],
)
def test_labels_of_a_scene_in_short(tmp_path, labels, words):
    scene = make_scene(30)
    write_ply(tmp_path / "scene.ply", scene, labels=np.resize(np.array(labels), 30))
    assert describe_scene(tmp_path / "scene.ply")["labels"] == words
