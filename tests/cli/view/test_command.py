"""`gsjax view`: what it opens, what it says, where it listens, and how it ends."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import replace

import cv2
import equinox as eqx
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

import gsjax
from gsjax.engine.distill.saved import Locations
from gsjax.engine.viewables import open_viewable
from gsjax.io.atomic import write_npz
from gsjax.io.ply import read_ply, write_ply
from gsjax.methods.parts import gaussians_at, moment
from gsjax.viz.viewer import open_viewer
from tests.cli.parts.test_edit import scene_and_trajectory
from tests.cli.parts.test_edit import write_run as write_parts_run
from tests.cli.view.conftest import some

pytest.importorskip("viser", reason="viser is not installed")


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


def test_photographs_of_a_fit_stand_where_it_moved_them(fitted, notes):
    given = open_viewable(fitted, notes)[0].shots
    refined = given.viewmats[0].copy()
    refined[:, :3, 3] += 0.01
    write_npz(fitted / "cameras.npz", {"names": np.array(given.names), "viewmats": refined})
    np.testing.assert_allclose(open_viewable(fitted, notes)[0].shots.viewmats[0], refined)


def test_photographs_of_a_fit_that_moved(fitted, photographs, notes):
    config = fitted / "config.yml"
    config.write_text(config.read_text().replace(str(photographs), "/nowhere/at/all"))
    scene, _ = open_viewable(fitted, notes, Locations(images=str(photographs)))
    assert len(scene.shots.names) == 9


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


def test_what_can_be_viewed_is_opened_in_python(tracked, ply, recording):
    assert gsjax.open_scene(str(ply)).gaussians.num == gsjax.read_gaussians(ply)[0].num
    scene = gsjax.open_scene(tracked)
    with np.load(tracked / "trajectory.npz") as saved:
        np.testing.assert_allclose(scene.at(2).means, saved["means"][2], atol=1e-6)
    shutil.rmtree(recording)
    with pytest.warns(UserWarning, match="its recording is not shown"):
        assert gsjax.open_scene(tracked).num_frames == 4
    with pytest.raises(IsADirectoryError, match=r"gsjax\.open_scene opens the scene"):
        gsjax.load(tracked)


def test_a_tracked_scene_whose_recording_is_gone_still_moves(tracked, recording, notes):
    shutil.rmtree(recording)
    scene, _ = open_viewable(tracked, notes)
    assert scene.num_frames == 4
    assert scene.shots is None
    assert scene.times is None
    assert any("its recording is not shown" in note for note in notes.all)
    assert scene.name_of(0) == "object 1"


def test_a_tracked_run_without_scores_yet_is_shown(tracked, notes):
    (tracked / "metrics.json").unlink()
    scene, _ = open_viewable(tracked, notes)
    assert (scene.num_frames, scene.shots) == (4, None)
    assert any("found no metrics.json" in note for note in notes.all)


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


def test_parts_without_scores_yet_are_shown(tmp_path, notes):
    write_parts_run(tmp_path / "parts")
    (tmp_path / "parts" / "metrics.json").unlink()
    scene, _ = open_viewable(tmp_path / "parts", notes)
    assert (scene.num_frames, len(scene.shots.names)) == (4, 3)
    assert scene.name_of(int(np.flatnonzero(scene.labels == 1)[0])) == "part 1"
    assert notes.all == []


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


# what it refuses


def test_nothing_there(view, tmp_path):
    code, said = view(tmp_path / "none")
    assert code == 2
    assert "none: expected a run or a file of Gaussians, found nothing there; check the path" in said


def test_a_folder_that_is_no_run(view, photographs):
    code, said = view(photographs)
    assert code == 2
    assert "expected the folder of a run" in said


def test_a_run_that_is_not_finished(view, fitted):
    (fitted / "scene.ply").unlink()
    code, said = view(fitted)
    assert code == 2
    assert "expected a run with scene.ply, found none; finish the run with --resume" in said


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
    assert "notes.txt: expected a file of Gaussians (.ply, .compressed.ply, .splat" in said
    points = np.zeros(3, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(tmp_path / "points.ply"))
    code, said = view(tmp_path / "points.ply")
    assert code == 2
    assert "This seems to be a point cloud or a mesh" in said
    write_ply(tmp_path / "empty.ply", some(0))
    code, said = view(tmp_path / "empty.ply")
    assert code == 2
    assert "empty.ply: expected Gaussians, found none that can be drawn" in said


@pytest.mark.parametrize("option", ["--scene", "--images", "--weights"])
def test_what_nobody_looks_for_is_refused(view, ply, tracked, option):
    for path, why in ((ply, "is a file"), (tracked, "has no field")):
        code, said = view(path, option, "x")
        assert code == 2
        assert f"{option}: {path} {why}, to which it does not apply" in said


def test_without_viser_it_says_what_to_install(view, ply, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    code, said = view(ply)
    assert code == 2
    assert "the viewer needs viser, which is not installed: " in said
    assert f"{sys.executable} -m pip install 'gsjax[viewer]'" in said


def test_bad_numbers(view, ply):
    code, said = view(ply, "--max-gaussians", "0")
    assert code == 2
    assert "max_gaussians: expected 1 or more, found 0" in said
    code, said = view(ply, "--port", "99999")
    assert code == 2
    assert "port: expected 0 (any that is free) to 65535, found 99999" in said
    code, said = view(ply, "--host", "no-such-host.invalid")
    assert code == 2
    assert "expected an address of this machine" in said


# where it listens, and what it says


def test_it_says_where_and_what_and_ends_by_ctrl_c(view, ply):
    code, said = view(ply, "--port", "0", "--max-gaussians", "10", "--up=-y")
    assert code == 130
    assert "scene 30 Gaussians, SH degree 0" in said
    assert "view http://127.0.0.1:" in said
    assert "the browser gets the 10 most opaque of 30 Gaussians" in said
    assert "everyone" not in said
    assert "viser" not in said


def test_the_address_is_printed_whole(view, ply, monkeypatch):
    def elsewhere(*arguments, **options):
        viewer = open_viewer(*arguments, **options)
        viewer.url = "http://[fd00::1]:8080"
        return viewer

    monkeypatch.setattr("gsjax.cli.view.open_viewer", elsewhere)
    assert "view http://[fd00::1]:8080 " in view(ply, "--port", "0")[1]


def test_a_port_in_use(view, ply, monkeypatch):
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        code, said = view(ply, "--port", port)
        assert code == 2
        assert f"port {port}: cannot listen there on 127.0.0.1" in said
        for module in ("gsjax.viz.viewer.server", "gsjax.cli.view"):
            monkeypatch.setattr(f"{module}.PORT", port)
        code, said = view(ply)
        assert code == 130
        assert f"port {port} is in use; this is " in said


def test_an_open_address_is_warned_of(view, ply):
    code, said = view(ply, "--host", "0.0.0.0", "--port", "0")
    assert code == 130
    assert "can view the scene, and save screenshots and films here" in said


@pytest.mark.thorough
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
    assert "stopped: the page is no longer served" in err


def test_a_file_with_a_mark_is_drawn_antialiased_and_its_bad_gaussians_are_counted(view, tmp_path, notes):
    bad = eqx.tree_at(lambda g: g.means, some(), some().means.at[3, 1].set(np.nan))
    write_ply(tmp_path / "marked.ply", bad, antialiased=True)
    scene, _ = open_viewable(tmp_path / "marked.ply", notes)
    assert scene.antialiased
    assert scene.gaussians.num == 29
    code, said = view(tmp_path / "marked.ply", "--port", 0)
    assert code == 130
    assert "1 of 30 Gaussians cannot be drawn (NaN, no rotation) and are left out" in said
