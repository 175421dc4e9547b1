"""`gsjax view`: what it opens, what it says, where it listens, and how it ends."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from rich.console import Console

from gsjax.cli import main
from gsjax.cli.distill.saved import Whereabouts
from gsjax.cli.distill.source import Source
from gsjax.cli.fit.command import Options as FitOptions
from gsjax.cli.messages import Notes
from gsjax.cli.run.folder import RunFolder
from gsjax.cli.track.command import Options as TrackOptions
from gsjax.cli.track.loop import Tracking
from gsjax.cli.track.outputs import write_tracking
from gsjax.cli.view.command import screenshots
from gsjax.cli.view.viewables import open_viewable
from gsjax.io.ply import read_ply, write_ply
from gsjax.methods.motion_parts import gaussians_at, moment
from gsjax.methods.object_tracker import Pose, TrackedScene
from gsjax.methods.reconstruction import FitConfig
from gsjax.perception.codebook import ClassCodebook
from gsjax.scene.gaussians import gaussians_from_activated
from tests.cli.conftest import write_made_field
from tests.cli.parts.test_edit import scene_and_trajectory
from tests.cli.parts.test_edit import write_run as write_parts_run

pytest.importorskip("viser", reason="viser is not installed")


def some(count=30):
    rng = np.random.default_rng(0)
    return gaussians_from_activated(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        rng.uniform(0.05, 0.1, (count, 3)),
        rng.uniform(0.2, 0.9, count),
        rng.uniform(size=(count, 3)),
    )


@pytest.fixture
def ply(tmp_path) -> Path:
    write_ply(tmp_path / "things.ply", some(), labels=np.arange(30) % 2)
    return tmp_path / "things.ply"


@pytest.fixture
def fitted(photographs, tmp_path) -> Path:
    """What a fit of the photographs leaves, but for its pictures."""
    folder = RunFolder(tmp_path / "fitted")
    folder.write_config(FitOptions(str(photographs), folder.path, fit=FitConfig(antialiased=True)))
    folder.write_metrics({"kind": "fit", "complete": True})
    write_ply(folder.scene, some())
    return folder.path


@pytest.fixture
def tracked(recording, tmp_path) -> Path:
    """What tracking leaves, but for its pictures: 12 of 30 Gaussians, of two objects, shift by 1 cm a frame.
    Camera 2 was held out."""
    gaussians, labels = some(), np.where(np.arange(30) < 12, 1 + np.arange(30) % 2, 0)
    scene = TrackedScene(gaussians, jnp.zeros((12, 3)), jnp.asarray(labels), (0, 2, 3), 12)
    means, quats = gaussians.means[:12], gaussians.quats[:12]
    poses = jax.device_get([Pose(means + 0.01 * t, quats) for t in range(4)])
    seen = [np.ones(2, bool)] * 3
    tracking = Tracking(scene, poses, update_s=[0.0] * 4, lost=[~known for known in seen], turn_known=seen)
    folder = RunFolder(tmp_path / "tracked")
    folder.write_config(TrackOptions(str(recording), folder.path, cameras=(0, 1), eval_cameras=(2,)))
    write_tracking(folder, tracking, np.arange(4) / 10)
    objects = {"carton": {"label": 2}, "can": {"label": 3}}
    folder.write_metrics({"mask": {"camera": 0, "source": "files"}, "objects": objects, "complete": True})
    return folder.path


@pytest.fixture
def notes():
    with Notes(Console(stderr=True)) as notes:
        yield notes


@pytest.fixture
def view(capfd, monkeypatch):
    """Runs the command as if Ctrl-C came at once; returns the exit code and what was said, spaces as one."""

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("gsjax.viz.viewer.Viewer.wait", interrupted)

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main(["view", *map(str, arguments)])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call


# what it opens


def test_a_fit_with_its_photographs(fitted, photographs, notes):
    scene, folder = open_viewable(fitted, notes)
    assert folder == fitted
    assert (scene.title, scene.gaussians.num, scene.num_frames) == ("fitted", 30, 1)
    assert scene.antialiased
    assert scene.shots.names[0] == "images/00.png"
    assert len(scene.shots.names) == 9
    picture = cv2.imread(str(photographs / "images" / "01.png"))[..., ::-1]
    np.testing.assert_array_equal(scene.shots.load_image(0, 1), picture)
    assert scene.colorings == ("colour", "depth")


def test_a_fit_whose_photographs_are_gone_is_shown_without(fitted, notes):
    config = fitted / "config.yml"
    text = config.read_text()
    dataset = next(line for line in text.splitlines() if line.startswith("dataset:"))
    config.write_text(text.replace(dataset, "dataset: /nowhere/at/all"))
    scene, _ = open_viewable(fitted, notes)
    assert scene.shots is None
    assert scene.antialiased
    assert any("its photographs are not shown: /nowhere/at/all" in note for note in notes.all)


def test_a_tracked_scene_over_time(tracked, notes):
    scene, _ = open_viewable(tracked, notes)
    assert scene.num_frames == 4
    assert scene.unit == "m"
    assert scene.names == {1: "carton", 2: "can"}
    assert [scene.name_of(row) for row in (0, 1, 20)] == ["carton", "can", "background"]
    assert scene.shots.names == ("camera 0", "camera 1", "camera 2 (held out)")
    assert scene.shots.viewmats.shape == (4, 3, 4, 4)
    assert scene.shots.load_image(3, 2).shape == (60, 80, 3)
    assert len(scene.times) == 4
    with np.load(tracked / "trajectory.npz") as saved:
        np.testing.assert_allclose(scene.at(2).means, saved["means"][2], atol=1e-6)
        np.testing.assert_array_equal(scene.labels, saved["labels"])
    np.testing.assert_allclose(scene.at(3).means[:12] - scene.at(0).means[:12], 0.03, atol=1e-6)
    assert scene.colorings == ("colour", "depth", "label")


def test_a_tracked_scene_whose_recording_is_gone_still_moves(tracked, recording, notes):
    shutil.rmtree(recording)
    scene, _ = open_viewable(tracked, notes)
    assert scene.num_frames == 4
    assert scene.shots is None
    assert scene.times is None
    assert any("its recording is not shown" in note for note in notes.all)
    assert scene.name_of(0) == "object 1"


def test_a_damaged_trajectory_is_said(tracked, view):
    (tracked / "trajectory.npz").write_bytes(b"half of it")
    code, said = view(tracked)
    assert code == 2
    assert "trajectory.npz: expected plain arrays" in said


def test_parts_over_time(tmp_path, notes):
    write_parts_run(tmp_path / "parts")
    scene, folder = open_viewable(tmp_path / "parts", notes)
    assert folder == tmp_path / "parts"
    found, trajectory = scene_and_trajectory()
    assert (scene.num_frames, scene.num_moving) == (4, 133)  # all but the background
    for t in (0, 3):
        expected = gaussians_at(found, moment(trajectory, t))
        ours, theirs = (
            np.asarray(g.means)[np.lexsort(np.asarray(g.means).T)] for g in (scene.at(t), expected)
        )
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert set(scene.labels[:133]) == {1, 2}
    assert scene.name_of(int(np.flatnonzero(scene.labels == 1)[0])) == "drawer"
    np.testing.assert_allclose(scene.times, np.arange(4) / 15, atol=1e-6)
    assert list(scene.shots.names) == ["camera 0", "camera 1", "camera 2 (held out)"]


def test_parts_without_their_recording(tmp_path, notes):
    write_parts_run(tmp_path / "parts", followed=2)
    scene, _ = open_viewable(tmp_path / "parts", notes)
    assert (scene.num_frames, scene.shots) == (2, None)
    config = tmp_path / "parts" / "config.yml"
    config.write_text(config.read_text().replace("simulated:articulated", "simulated:nothing"))
    scene, _ = open_viewable(tmp_path / "parts", notes)
    assert scene.shots is None
    assert any("its recording is not shown" in note for note in notes.all)


def test_a_ply_file(ply, notes):
    scene, folder = open_viewable(ply, notes)
    assert folder == ply.parent
    assert scene.title == "things.ply"
    assert scene.shots is None
    assert scene.colorings == ("colour", "depth", "label")


def test_rows_that_cannot_be_drawn_are_left_out_and_counted(ply, notes):
    gaussians, _ = read_ply(ply)
    write_ply(ply, replace_first_mean(gaussians, np.nan))
    scene, _ = open_viewable(ply, notes)
    assert scene.gaussians.num == 29
    assert any("1 of 30 Gaussians cannot be drawn" in note for note in notes.all)


def replace_first_mean(gaussians, value):
    return replace(gaussians, means=gaussians.means.at[0, 0].set(value))


# what can be asked


NAMES = {1: "table", 2: "can"}
CODES = np.stack([ClassCodebook(NAMES).embed_text(name) for name in NAMES.values()])


@pytest.fixture
def asked(fitted) -> Path:
    """The field of a fit, whose odd Gaussians are a can."""
    labels, source = np.arange(30) % 2, Source("classes", NAMES)
    return write_made_field(fitted / "field", fitted / "scene.ply", None, source, labels, CODES)


def test_a_fit_is_asked_by_its_field(fitted, asked, notes):
    scene, _ = open_viewable(fitted, notes)
    assert scene.asking is not None
    assert scene.shots is not None
    assert scene.asking.hint == "One of: can, table"
    found = scene.asking.ask("can", 0)
    np.testing.assert_array_equal(found.scores > found.threshold, np.arange(30) % 2 == 1)
    found = scene.asking.like(4, 0)
    np.testing.assert_array_equal(found.scores > found.threshold, np.arange(30) % 2 == 0)
    with pytest.raises(ValueError, match="no class 'spoon'"):
        scene.asking.ask("spoon", 0)
    assert not any("field" in note for note in notes.all)


def test_a_scene_is_read_once(fitted, asked, notes, monkeypatch):
    read = []
    monkeypatch.setattr("gsjax.cli.run.files.read_ply", lambda file: read.append(file) or read_ply(file))
    open_viewable(fitted, notes)
    assert read == [fitted / "scene.ply"]


def test_a_field_alone_is_asked_of_the_scene_that_is_named(fitted, asked, tmp_path, notes, view):
    write_ply(fitted / "scene.ply", some(), labels=np.arange(30) % 3)  # not as it was
    scene, _ = open_viewable(fitted, notes)
    assert any("is not as it was when the field in" in note for note in notes.all)
    mine = tmp_path / "mine"
    mine.mkdir()
    shutil.copy(asked / "field.npz", mine)
    shutil.move(fitted / "scene.ply", tmp_path / "moved.ply")
    code, said = view(mine, "--port", 0)
    assert code == 2
    assert "--scene names it" in said
    code, said = view(mine, "--port", 0, "--scene", tmp_path / "moved.ply")
    assert code == 130, said
    assert "can be asked" in said
    scene, folder = open_viewable(mine, notes, Whereabouts(tmp_path / "moved.ply"))
    assert folder == mine
    np.testing.assert_array_equal(scene.labels, np.arange(30) % 3)


def test_what_was_found_is_kept_and_nothing_written_over(fitted, asked, notes, monkeypatch):
    write_ply(fitted / "scene.ply", some(), labels=np.arange(30) % 3)
    asking, selected = open_viewable(fitted, notes)[0].asking, np.arange(30) < 4
    paths = [asking.save(selected, "The Can, object", 0) for _ in range(2)]
    assert [path.name for path in paths] == ["the_can_object.ply", "the_can_object_2.ply"]
    gaussians, report = read_ply(paths[1])
    np.testing.assert_array_equal(gaussians.means, some().means[:4])
    np.testing.assert_array_equal(report.labels, [0, 1, 2, 0])

    def full(*args, **options):
        raise OSError("no space")

    monkeypatch.setattr("gsjax.cli.query.selected.write_ply", full)
    with pytest.raises(OSError, match="no space"):
        asking.save(selected, "x", 0)
    assert sorted(asked.joinpath("extracted").iterdir()) == paths


def test_who_reads_texts_is_loaded_once(fitted, asked, notes, monkeypatch):
    encoder, loaded = Source.encoder, []
    monkeypatch.setattr(
        Source, "encoder", lambda self, weights: loaded.append(weights) or encoder(self, weights)
    )
    asking = open_viewable(fitted, notes)[0].asking
    assert not loaded
    for text in ("can", "table", "can"):
        asking.ask(text, 0)
    assert len(loaded) == 1


@pytest.mark.parametrize(
    ("source", "hint"),
    [
        (Source("closed", {1: "table"}), "Colours and outlines: black"),
        (Source("files"), "No words (--weights"),
        (Source("clip", weights="x"), "Any words"),
    ],
)
def test_what_can_be_asked_for_is_said(fitted, notes, source, hint):
    labels, vectors = np.arange(30) % 2, np.eye(2)
    write_made_field(fitted / "field", fitted / "scene.ply", None, source, labels, vectors)
    asking = open_viewable(fitted, notes)[0].asking
    assert asking.hint.startswith(hint)
    if source.kind == "files":
        with pytest.raises(ValueError, match="--weights names its folder"):
            asking.ask("can", 0)
        assert open_viewable(fitted, notes, Whereabouts(weights=Path("x")))[0].asking.hint == "Any words"


def test_a_field_of_another_scene_is_not_asked(fitted, asked, tmp_path, notes):
    shutil.move(fitted / "scene.ply", tmp_path / "first.ply")
    write_ply(fitted / "scene.ply", some(20))
    told = dict(np.load(asked / "field.npz"))
    np.savez(asked / "field.npz", **{**told, "vectors": told["vectors"][:7]})
    scene, _ = open_viewable(fitted, notes)
    assert (scene.gaussians.num, scene.asking) == (20, None)
    assert any("its field cannot be asked" in note for note in notes.all)


def test_what_moves_says_where_its_field_is_asked(tracked, notes):
    source = Source("classes", NAMES)
    labels = np.arange(30) % 2
    field = write_made_field(tracked / "field", tracked / "scene.ply", None, source, labels, CODES)
    scene, _ = open_viewable(tracked, notes)
    assert scene.asking is None
    assert any(f"gsjax view {field} shows what its field is of" in note for note in notes.all)
    assert open_viewable(field, notes)[0].asking is not None


def test_photographs_of_a_fit_that_moved(fitted, photographs, notes):
    config = fitted / "config.yml"
    config.write_text(config.read_text().replace(str(photographs), "/nowhere/at/all"))
    scene, _ = open_viewable(fitted, notes, Whereabouts(images=str(photographs)))
    assert len(scene.shots.names) == 9


@pytest.mark.parametrize("option", ["--scene", "--images", "--weights"])
def test_what_nobody_looks_for_is_refused(view, ply, tracked, option):
    for path in (ply, tracked):
        code, said = view(path, option, "x")
        assert code == 2
        assert f"{option}: {path} is" in said


# what it refuses


def test_nothing_there(view, tmp_path):
    code, said = view(tmp_path / "none")
    assert code == 2
    assert "none: expected a run or a PLY file, found nothing there; check the path" in said


def test_a_folder_that_is_no_run(view, photographs):
    code, said = view(photographs)
    assert code == 2
    assert "expected the folder of a run" in said


def test_a_run_that_is_not_finished(view, fitted):
    (fitted / "scene.ply").unlink()
    code, said = view(fitted)
    assert code == 2
    assert "expected a run with scene.ply, found none: it is not finished" in said


def test_a_fit_with_foreign_settings(view, fitted):
    (fitted / "config.yml").write_text("# gsjax run\ndataset: x\n")
    code, said = view(fitted)
    assert code == 2
    assert "expected the settings of a fit" in said


def test_files_without_gaussians(view, tmp_path):
    other = tmp_path / "notes.txt"
    other.write_text("hello")
    code, said = view(other)
    assert code == 2
    assert "expected a PLY file or the folder of a run" in said
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(tmp_path / "points.ply"))
    code, said = view(tmp_path / "points.ply")
    assert code == 2
    assert "This seems to be a point cloud or a mesh" in said
    write_ply(tmp_path / "empty.ply", some(0))
    code, said = view(tmp_path / "empty.ply")
    assert code == 2
    assert "empty.ply: expected Gaussians, found none that can be drawn" in said


def test_without_viser_it_says_what_to_install(view, ply, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    code, said = view(ply)
    assert code == 2
    assert 'viser is not installed: pip install "gsjax[viewer]"' in said


def test_bad_numbers(view, ply):
    code, said = view(ply, "--max-gaussians", "0")
    assert code == 2
    assert "max_gaussians: expected 1 or more, found 0" in said
    code, said = view(ply, "--port", "99999")
    assert code == 2
    assert "port: expected 0 (any that is free) to 65535, found 99999" in said
    code, said = view(ply, "--host", "no-such-host.invalid")
    assert code == 2
    assert "is no address of this machine" in said


# where it listens, and what it says


def test_it_says_where_and_what_and_ends_by_ctrl_c(view, ply):
    code, said = view(ply, "--port", "0", "--max-gaussians", "10", "--up=-y")
    assert code == 130
    assert "scene 30 Gaussians, SH degree 0" in said
    assert "view http://127.0.0.1:" in said
    assert "the browser gets the 10 most opaque of 30 Gaussians" in said
    assert "everyone" not in said
    assert "viser" not in said


def test_a_port_in_use(view, ply, monkeypatch):
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        code, said = view(ply, "--port", port)
        assert code == 2
        assert f"port {port}: cannot listen there on 127.0.0.1" in said
        for module in ("gsjax.viz.viewer.server", "gsjax.cli.view.command"):
            monkeypatch.setattr(f"{module}.PORT", port)
        code, said = view(ply)
        assert code == 130
        assert f"port {port} is in use; this is " in said


def test_an_open_address_is_warned_of(view, ply):
    code, said = view(ply, "--host", "0.0.0.0", "--port", "0")
    assert code == 130
    assert "everyone who reaches this machine over the network can look" in said


def test_a_page_is_served_until_ctrl_c(ply):
    """The program itself, in a process of its own."""
    command = [sys.executable, "-m", "gsjax.cli", "view", str(ply), "--port", "0"]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        said = ""
        while "http://" not in said:
            line = process.stdout.readline()
            assert line, process.stderr.read()
            said += line
        url = said.split("http://")[1].split()[0]
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(f"http://{url}", timeout=30) as page:
            assert b"<html" in page.read()
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in out + err
    assert "stopped: nobody can look any more" in err


# screenshots


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

    monkeypatch.setattr("gsjax.cli.view.command.write_png", full)
    with pytest.raises(OSError, match="no space"):
        screenshots(tmp_path)("render", np.zeros((4, 6, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
