"""`gsjax export`: runs and files in every format, what it says, and what it refuses."""

import json
import os
import re
import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from gsjax.data.open import open_sequence
from gsjax.engine.folder import RunFolder
from gsjax.engine.track.outputs import write_tracking
from gsjax.engine.track.saved import read_tracking
from gsjax.io.ply import write_ply
from gsjax.io.scenes import FORMATS, read_gaussians
from gsjax.scene.origin import in_world
from tests.cli.view.conftest import some
from tests.io.scenes_to_write import ROUNDING, assert_alike


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_in_every_format(export, ply, ending):
    out = ply.parent / "[made]" / f"scene{ending}"
    code, said = export(ply, out)
    assert code == 0
    assert f"scene {out}: 30 Gaussians, {FORMATS[ending].name}, " in said
    if ending in ROUNDING:
        assert_alike(some(), read_gaussians(out)[0], ROUNDING[ending])
    names = {out.name, "scene_labels.npz"} if ending == ".ply" else {out.name}
    assert {file.name for file in out.parent.iterdir()} == names
    assert ("leaves out labels" in said) == (ending != ".ply")


def test_a_fit_keeps_its_antialiasing(export, fitted, tmp_path):
    code, said = export(fitted, tmp_path / "scene.spz")
    assert code == 0
    assert "leaves out" not in said
    assert read_gaussians(tmp_path / "scene.spz")[1].antialiased
    code, said = export(fitted, tmp_path / "scene.splat")
    assert "the scene is antialiased" in said


def test_photographs_that_are_gone_are_missed_by_a_page_alone(export, fitted, tmp_path):
    settings = (fitted / "config.yml").read_text()
    (fitted / "config.yml").write_text(re.sub("(?m)^data(set)?: .*", r"data\1: /gone/away", settings))
    assert "its photographs are not shown: " in export(fitted, tmp_path / "scene.html")[1]
    assert '"up": [0.0, -1.0, 0.0]' in (tmp_path / "scene.html").read_text()  # as of its scene.ply
    assert "warning" not in export(fitted, tmp_path / "scene.spz")[1]


def test_a_tracked_scene_is_its_first_frame(export, tracked, tmp_path):
    code, said = export(tracked, tmp_path / "scene.sog")
    assert code == 0
    assert "moves; only its first of 4 frames is written. A page (.html) plays all, and " in said
    assert "'frame_####.sog' writes a file for each" in said
    assert_alike(some(), read_gaussians(tmp_path / "scene.sog")[0], ROUNDING[".sog"])


def test_a_page_of_a_tracked_scene_plays_at_the_rate_of_its_recording(export, tracked, recording, tmp_path):
    code, said = export(tracked, tmp_path / "scene.html", "--frames=1:")
    assert code == 0
    assert said.count("warning") == said.count("a page leaves out labels") == 1
    assert "30 Gaussians, a page of 3 frames, " in said
    about = json.loads(re.search(r"const about = (\{.*\});", (tmp_path / "scene.html").read_text())[1])
    assert about["motion"]["moving"] == 12
    times = open_sequence(str(recording)).times[1:4]
    np.testing.assert_allclose(about["motion"]["times"], times - times[0], atol=1e-6)


@pytest.mark.parametrize("ending", [".ply", ".html"])
def test_of_frames_in_which_nothing_moves_no_motion_is_told(export, tmp_path, ending):
    for frame in range(3):
        write_ply(tmp_path / "frames" / f"{frame}.ply", some())
    code, said = export(tmp_path / "frames", tmp_path / f"scene{ending}")
    assert (code, "of 3 frames" in said, "moves" in said) == (0, False, False), said


@pytest.mark.parametrize("ending", [".ply", ".sog"])
def test_a_file_for_each_frame(export, tracked, tmp_path, ending):
    out = tmp_path / "out" / f"frame_####{ending}"
    code, said = export(tracked, out, "--frames=1::2")
    assert code == 0
    assert "moves" not in said
    assert f"scene {out}: 2 files of 30 Gaussians, " in said
    names = [f"frame_0001{ending}", f"frame_0003{ending}"]
    assert sorted(file.name for file in out.parent.glob(f"*{ending}")) == names
    moved = jnp.where(jnp.arange(30)[:, None] < 12, some().means + 0.03, some().means)
    wanted = eqx.tree_at(lambda g: g.means, some(), moved)
    assert_alike(wanted, read_gaussians(out.parent / names[1])[0], ROUNDING[ending])
    code, said = export(tracked, out)
    assert code == 2
    assert f"frame_0001{ending}: is there already" in said
    assert len(list(out.parent.glob(f"*{ending}"))) == 2


def test_ctrl_c_leaves_whole_files_only(export, tracked, tmp_path, monkeypatch):
    replace, calls = os.replace, []

    def interrupted(*paths):
        calls.append(paths)
        if len(calls) > 2:
            raise KeyboardInterrupt
        replace(*paths)

    monkeypatch.setattr("gsjax.io.atomic.os.replace", interrupted)
    code, said = export(tracked, tmp_path / "out" / "#.splat")
    assert code == 130
    assert "2 files of 4 (stopped by Ctrl-C) of 30 Gaussians" in said
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["0.splat", "1.splat"]


def test_a_page_of_a_run_has_the_up_of_its_photographs(export, fitted, ply, tmp_path):
    for source, option, up in (
        (ply, (), "[0.0, -1.0, 0.0]"),
        (ply, ("--up=z",), "[0.0, 0.0, 1.0]"),
    ):
        code, _ = export(source, tmp_path / "scene.html", *option, "--overwrite")
        assert code == 0
        assert f'"up": {up}' in (tmp_path / "scene.html").read_text()
        assert '"view": null' in (tmp_path / "scene.html").read_text()
    assert export(fitted, tmp_path / "fit.html")[0] == 0
    about = json.loads(re.search(r"const about = (\{.*\});", (tmp_path / "fit.html").read_text())[1])
    assert about["up"] == pytest.approx([0, 0, 1], abs=0.1)  # the built-in table's; a file's is -y
    assert about["antialiased"]


def test_a_page_of_a_run_opens_where_its_first_camera_stood(export, tracked, recording, tmp_path):
    assert export(tracked, tmp_path / "scene.html")[0] == 0
    about = json.loads(re.search(r"const about = (\{.*\});", (tmp_path / "scene.html").read_text())[1])
    eye, target = np.array(about["view"])
    to_world = np.linalg.inv(open_sequence(str(recording)).viewmats[0, 0])
    np.testing.assert_allclose(eye, to_world[:3, 3], atol=1e-6)
    np.testing.assert_allclose(np.cross(target - eye, to_world[:3, 2]), 0, atol=1e-6)


def test_what_is_read_in_one_format_is_written_in_another(export, ply, tmp_path):
    for ending in (".splat", ".compressed.ply", ".spz", ".sog", ".ply"):
        before, ply = ply, tmp_path / f"next{ending}"
        assert export(before, ply)[0] == 0
    np.testing.assert_allclose(
        np.sort(read_gaussians(ply)[0].means, axis=0), np.sort(some().means, axis=0), atol=0.02
    )


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
def test_a_scene_far_from_0_keeps_its_places(export, tmp_path):
    """In UTM coordinates, to a .ply and back; the precision of other formats does not suffice for them."""
    far, origin = tmp_path / "far.ply", np.array([500_000.0, 5_000_000.0, 300.0])
    write_ply(far, some(), origin=origin)
    assert export(far, tmp_path / "again.ply")[0] == 0
    back, report = read_gaussians(tmp_path / "again.ply")
    found = in_world(np.asarray(back.means), report.origin)
    np.testing.assert_allclose(found, np.asarray(some().means) + origin, rtol=0, atol=1e-6)
    code, said = export(far, tmp_path / "scene.spz")
    assert code == 0
    assert "SPZ leaves out the origin (500000, 5000000, 300), to which its places are relative" in said
    assert_alike(some(), read_gaussians(tmp_path / "scene.spz")[0], ROUNDING[".spz"])


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
def test_a_run_far_from_0_keeps_its_places_in_each_frame(export, tracked, tmp_path):
    origin = np.array([500_000.0, 5_000_000.0, 300.0])
    far = RunFolder(tmp_path / "far")
    write_tracking(far, read_tracking(tracked)[0], np.arange(4) / 10, origin)
    for name in ("config.yml", "metrics.json"):
        shutil.copy(tracked / name, far.path)
    with np.load(far.path / "trajectory.npz") as run:
        assert run["poses"].shape == (4, 2, 4, 4)
        for k in (1, 2):  # the motion of each object, in the world, moves its Gaussians
            mine = run["means"][:, run["labels"] == k]
            moved = mine[0] @ run["poses"][3, k - 1, :3, :3].T + run["poses"][3, k - 1, :3, 3]
            np.testing.assert_allclose(moved, mine[3], rtol=0, atol=1e-6)
    assert export(far.path, tmp_path / "#.ply", "--frames=2:3")[0] == 0
    back, report = read_gaussians(tmp_path / "2.ply")
    wanted = np.asarray(some().means) + origin
    wanted[:12] += 0.02
    np.testing.assert_allclose(in_world(np.asarray(back.means), report.origin), wanted, rtol=0, atol=1e-6)


def test_what_is_refused(export, ply, tmp_path):
    out = tmp_path / "scene.spz"
    for arguments, says in (
        ((ply, tmp_path / "a.obj"), "a.obj: expected one of the endings .compressed.ply, .ply, .splat, .spz"),
        ((ply, tmp_path / "a.ksplat"), "found .ksplat, which is only read"),
        ((ply, ply), "things.ply: expected another file than the one that is read"),
        (
            (tmp_path / "none.ply", out),
            "none.ply: expected a run or a file of Gaussians, found nothing there",
        ),
        ((ply, tmp_path / "#_#.ply"), "expected one run of # for the number of the frame, found several"),
        ((ply, out, "--frames=5:"), "--frames: 5: selects no frame of the scene, which has 1"),
        ((ply, out, "--frames=5"), "--frames: expected START:STOP or START:STOP:STEP"),
        ((ply, out, "--up=z"), "--up: expected OUT to be a page (.html), found"),
    ):
        code, said = export(*arguments)
        assert (code, says in said) == (2, True), said
    assert not out.exists()
    (tmp_path / "folder.spz").mkdir()
    code, said = export(ply, tmp_path / "folder.spz")
    assert code == 2
    assert "expected a file, found a folder" in said


def test_brackets_in_a_name_are_printed(export, ply):
    out = ply.parent / "a[" / "made[final].ply"
    code, said = export(ply, out)
    assert code == 0
    assert f"writing {out}" in said
    assert f"scene {out}: 30 Gaussians" in said
    assert export(ply, ply.parent / "a[" / "[/b].ply")[0] == 0


def test_a_file_of_a_run_is_not_replaced(export, fitted):
    before = (fitted / "scene.ply").read_bytes()
    code, said = export(fitted, fitted / "scene.ply", "--overwrite")
    assert code == 2
    assert "scene.ply: expected another file than one that a run wrote" in said
    assert (fitted / "scene.ply").read_bytes() == before


def test_labels_go_with_a_ply(export, ply, tmp_path):
    """A file of labels that is there already belongs to the user, and is not replaced unasked."""
    out, beside = tmp_path / "made" / "out.ply", tmp_path / "made" / "out_labels.npz"
    beside.parent.mkdir()
    beside.write_bytes(b"mine")
    code, said = export(ply, out)
    assert (code, "out_labels.npz: is there already; name another OUT" in said) == (2, True), said
    assert (beside.read_bytes(), out.exists()) == (b"mine", False)
    assert export(ply, out, "--overwrite")[0] == 0
    np.testing.assert_array_equal(read_gaussians(out)[1].labels, np.arange(30) % 2)


def test_nothing_is_replaced_unasked(export, ply, tmp_path):
    out = tmp_path / "scene.spz"
    out.write_bytes(b"mine")
    code, said = export(ply, out)
    assert code == 2
    assert "is there already; name another OUT, or replace it with --overwrite" in said
    assert out.read_bytes() == b"mine"
    assert export(ply, out, "--overwrite")[0] == 0
    assert read_gaussians(out)[0].num == 30
