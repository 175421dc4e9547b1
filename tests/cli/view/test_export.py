"""`gsjax export`: runs and files in every format, what it says, and what it refuses."""

import equinox as eqx
import numpy as np
import pytest

from gsjax.cli import main
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import write_ply
from gsjax.io.scenes import FORMATS, read_gaussians
from gsjax.io.sequences import write_frames
from gsjax.scene.origin import in_world
from tests.cli.view.conftest import some
from tests.io.scenes_to_write import ROUNDING, assert_alike

READ_BACK = tuple(ROUNDING)


@pytest.fixture
def export(capfd):
    """Runs the command; returns the exit code and what was said, spaces as one."""

    def call(*arguments) -> tuple[int, str]:
        capfd.readouterr()
        code = main(["export", *map(str, arguments)])
        said = "".join(capfd.readouterr())
        assert "Traceback" not in said
        return code, " ".join(said.split())

    return call


@pytest.mark.parametrize("ending", FORMATS)
def test_a_file_in_every_format(export, ply, ending):
    out = ply.parent / "made" / f"scene{ending}"
    code, said = export(ply, out)
    assert code == 0
    assert f"scene {out}: 30 Gaussians, {FORMATS[ending].name}, " in said
    if ending in ROUNDING:
        assert_alike(some(), read_gaussians(out)[0], ROUNDING[ending])
    assert [file.name for file in out.parent.iterdir()] == [out.name]


def test_a_fit_keeps_its_antialiasing(export, fitted, tmp_path):
    code, said = export(fitted, tmp_path / "scene.spz")
    assert code == 0
    assert "leaves out" not in said
    assert read_gaussians(tmp_path / "scene.spz")[1].antialiased
    code, said = export(fitted, tmp_path / "scene.splat")
    assert "the scene is antialiased" in said


def test_a_file_of_one_frame_of_a_scene_that_moves(export, tracked, tmp_path):
    code, said = export(tracked, tmp_path / "scene.sog")
    assert code == 0
    assert "moves; only frame 0 of 4 is written" in said
    assert_alike(some(), read_gaussians(tmp_path / "scene.sog")[0], ROUNDING[".sog"])
    code, said = export(tracked, tmp_path / "third.ply", "--frames=2:3")
    assert code == 0
    assert "moves" not in said
    np.testing.assert_allclose(read_gaussians(tmp_path / "third.ply")[0].means, later(2), atol=1e-6)


def later(frame):
    """Centres of the tracked scene."""
    means = np.array(some().means)
    means[:12] += 0.01 * frame
    return means


@pytest.mark.parametrize("ending", READ_BACK)
def test_frames_as_numbered_files(export, tracked, tmp_path, notes, ending):
    folder = tmp_path / "frames"
    code, said = export(tracked, folder / f"%04d{ending}", "--frames=1:")
    assert code == 0
    assert f"3 frames of 30 Gaussians, {FORMATS[ending].name}" in said
    assert sorted(file.name for file in folder.iterdir()) == [f"000{t}{ending}" for t in (1, 2, 3)]
    scene, _ = open_viewable(folder, notes)
    assert (scene.num_frames, notes.all) == (3, [])
    rows = np.argmin(np.linalg.norm(later(1)[:, None] - np.asarray(scene.at(0).means), axis=2), axis=1)
    for row, frame in enumerate((1, 2, 3)):  # the same Gaussians in the same rows
        there = np.asarray(scene.at(row).means)[rows]
        np.testing.assert_allclose(there, later(frame), atol=2 * ROUNDING[ending].means)
        np.testing.assert_allclose(scene.at(row).sh0[rows], some().sh0, atol=0.07)


def test_numbered_files_are_a_scene_for_every_command(export, tracked, tmp_path, view, capfd):
    folder = tmp_path / "frames"
    export(tracked, folder / "f%d.ply")
    (folder / "f9_labels.npz").touch()
    code, said = view(folder)
    assert (code, "30 Gaussians, SH degree 0, 4 frames" in said) == (130, True), said
    capfd.readouterr()
    assert main(["info", str(folder)]) == 0
    assert "4, f0.ply to f3.ply" in " ".join(capfd.readouterr().out.split())
    code, said = export(folder, tmp_path / "again" / "%02d.spz")
    assert (code, len(list((tmp_path / "again").glob("0?.spz")))) == (0, 4), said
    code, said = export(folder, tmp_path / "frames.html")
    assert (code, "4 frames of 30 Gaussians, a page" in said) == (0, True), said
    text = (tmp_path / "frames.html").read_text()
    assert '"up": [0.0, -1.0, 0.0]' in text
    code, said = export(folder, folder / "f%d.ply", "--overwrite")
    assert (code, "expected another file than the one that is read" in said) == (2, True), said
    write_ply(folder / "f4.ply", some(7))
    code, said = view(folder)
    assert (code, "f4.ply: expected 30 Gaussians of degree 0 as in f0.ply, found 7" in said) == (2, True), (
        said
    )


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
def test_numbered_files_of_a_scene_far_from_0_share_an_origin(tmp_path, notes):
    """Each file is read relative to an origin of its own, near its middle."""
    origin = np.array([500_000.0, 5_000_000.0, 300.0])
    frames = [eqx.tree_at(lambda g: g.means, some(), some().means + 40.0 * t) for t in range(3)]
    write_frames(tmp_path / "%d.ply", enumerate(frames), origin=origin)
    origins = {tuple(read_gaussians(tmp_path / f"{t}.ply")[1].origin) for t in range(3)}
    assert len(origins) == 3
    scene, _ = open_viewable(tmp_path, notes)
    for t, frame in enumerate(frames):
        found = in_world(np.asarray(scene.at(t).means), scene.origin)
        np.testing.assert_allclose(found, np.asarray(frame.means) + origin, rtol=0, atol=1e-5)


def test_frames_of_before_are_kept_and_told(export, tracked, tmp_path):
    out = tmp_path / "frames" / "%04d.ply"
    assert export(tracked, out)[0] == 0
    before = {file: file.read_bytes() for file in out.parent.iterdir()}
    code, said = export(tracked, out)
    assert (code, "0000.ply: is there already" in said) == (2, True), said
    code, said = export(tracked, out, "--frames=:2", "--overwrite")
    assert (code, "holds 2 more numbered files, such as 0002.ply" in said) == (0, True), said
    assert {file: file.read_bytes() for file in out.parent.iterdir()} == before


def test_a_page_of_a_run_has_the_up_of_its_photographs(export, fitted, ply, tmp_path):
    for source, option, up in (
        (ply, (), "[0.0, -1.0, 0.0]"),
        (ply, ("--up=z",), "[0.0, 0.0, 1.0]"),
    ):
        code, _ = export(source, tmp_path / "scene.html", *option, "--overwrite")
        assert code == 0
        assert f'"up": {up}' in (tmp_path / "scene.html").read_text()
    assert export(fitted, tmp_path / "fit.html")[0] == 0
    assert '"antialiased": true' in (tmp_path / "fit.html").read_text()


def test_what_is_read_in_one_format_is_written_in_another(export, ply, tmp_path):
    for ending in (".splat", ".compressed.ply", ".spz", ".sog", ".ply"):
        before, ply = ply, tmp_path / f"next{ending}"
        assert export(before, ply)[0] == 0
    np.testing.assert_allclose(
        np.sort(read_gaussians(ply)[0].means, axis=0), np.sort(some().means, axis=0), atol=0.02
    )


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
def test_a_scene_far_from_0_keeps_its_places(export, tmp_path):
    """In UTM coordinates, to a .ply and back from it; other formats have no room for these digits."""
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


def test_what_is_refused(export, ply, tracked, tmp_path):
    out = tmp_path / "scene.spz"
    for arguments, says in (
        ((ply, tmp_path / "a.obj"), "a.obj: expected one of the endings .compressed.ply, .ply, .splat, .spz"),
        ((ply, tmp_path / "a.ksplat"), "found .ksplat, which is only read"),
        ((ply, ply), "things.ply: expected another file than the one that is read"),
        (
            (tmp_path / "none.ply", out),
            "none.ply: expected a run or a file of Gaussians, found nothing there",
        ),
        ((ply, out, "--up=z"), "--up: expected OUT to be a page (.html), found"),
    ):
        code, said = export(*arguments)
        assert (code, says in said) == (2, True), said
    assert not out.exists()
    (tmp_path / "folder.spz").mkdir()
    for arguments, says in (
        ((ply, tmp_path / "%04d.ply"), "has a place for numbers, and"),
        ((tracked, tmp_path / "%04d.html"), "expected one page, which plays all frames"),
        ((tracked, tmp_path / "a.html", "--frames=4:"), "--frames 4:: expected some of the 4 frames of"),
        ((tracked, tmp_path / "a.ply", "--frames=4"), "--frames: expected START:STOP"),
    ):
        code, said = export(*arguments)
        assert (code, says in said) == (2, True), said
    code, said = export(ply, tmp_path / "folder.spz")
    assert code == 2
    assert "expected a file, found a folder" in said


def test_nothing_is_replaced_unasked(export, ply, tmp_path):
    out = tmp_path / "scene.spz"
    out.write_bytes(b"mine")
    code, said = export(ply, out)
    assert code == 2
    assert "is there already; name another OUT, or replace it with --overwrite" in said
    assert out.read_bytes() == b"mine"
    assert export(ply, out, "--overwrite")[0] == 0
    assert read_gaussians(out)[0].num == 30
