"""Scenes that move as numbered files: written by `gsjax export`, and read as one scene."""

import equinox as eqx
import numpy as np
import pytest

from gsjax.cli import main
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import write_ply
from gsjax.io.scenes import FORMATS, read_gaussians
from gsjax.scene.origin import in_world
from tests.cli.view.conftest import some
from tests.io.scenes_to_write import ROUNDING


def later(frame):
    """The centres of the tracked scene in a frame."""
    means = np.array(some().means)
    means[:12] += 0.01 * frame
    return means


@pytest.mark.parametrize("ending", tuple(ROUNDING))
def test_frames_as_numbered_files(export, tracked, tmp_path, notes, ending):
    folder = tmp_path / "frames"
    code, said = export(tracked, folder / f"####{ending}", "--frames=1:")
    assert code == 0
    assert f"3 files of 30 Gaussians, {FORMATS[ending].name}" in said
    assert sorted(file.name for file in folder.glob(f"*{ending}")) == [f"000{t}{ending}" for t in (1, 2, 3)]
    scene, _ = open_viewable(folder, notes)
    assert (scene.num_frames, notes.all) == (3, [])
    rows = np.argmin(np.linalg.norm(later(1)[:, None] - np.asarray(scene.at(0).means), axis=2), axis=1)
    for row, frame in enumerate((1, 2, 3)):  # the same Gaussians in the same rows
        there = np.asarray(scene.at(row).means)[rows]
        np.testing.assert_allclose(there, later(frame), atol=2 * ROUNDING[ending].means)
        np.testing.assert_allclose(scene.at(row).sh0[rows], some().sh0, atol=0.07)


def test_numbered_files_are_a_scene_for_every_command(export, tracked, tmp_path, view, capfd):
    folder = tmp_path / "frames"
    export(tracked, folder / "f#.ply")
    for beside in ("f9_labels.npz", "note.txt", "NOTES.TXT", "README", ".DS_Store"):
        (folder / beside).touch()
    code, said = view(folder)
    assert (code, "30 Gaussians, SH degree 0, 4 frames" in said) == (130, True), said
    capfd.readouterr()
    assert main(["info", str(folder)]) == 0
    assert "4, f0.ply to f3.ply" in " ".join(capfd.readouterr().out.split())
    code, said = export(folder, tmp_path / "again" / "##.spz")
    assert (code, len(list((tmp_path / "again").glob("0?.spz")))) == (0, 4), said
    code, said = export(folder, tmp_path / "frames.html")
    assert (code, "30 Gaussians, a page of 4 frames" in said) == (0, True), said
    text = (tmp_path / "frames.html").read_text()
    assert '"up": [0.0, -1.0, 0.0]' in text
    (folder / "f2.ply").rename(folder / "g")
    code, said = export(folder, tmp_path / "gap.html")
    assert (code, f"warning: {folder}: no frame 2 among 3; add it, or renumber" in said) == (0, True), said
    (folder / "g").rename(folder / "f2.ply")
    code, said = export(folder, folder / "f#.ply", "--overwrite")
    assert (code, "expected another file than the one that is read" in said) == (2, True), said
    write_ply(folder / "f4.ply", some(7))
    code, said = view(folder)
    unlike = "f4.ply: expected 30 Gaussians of degree 0 as in f0.ply, found 7"
    assert (code, unlike in said) == (2, True), said
    assert main(["info", str(folder)]) == 0
    told = capfd.readouterr()
    assert f"warning: {folder / unlike}" in " ".join(told.err.split())
    assert "5, f0.ply to f4.ply, " in " ".join(told.out.split())
    write_ply(folder / "f4.ply", eqx.tree_at(lambda g: g.means, some(), some().means.at[3, 0].set(np.nan)))
    code, said = view(folder)
    assert (code, "as in f0.ply, found 1 that cannot, of 30; leave these out" in said) == (2, True), said


@pytest.mark.filterwarnings("ignore:.*they are taken relative to the origin")
def test_numbered_files_of_a_scene_far_from_0_share_an_origin(tmp_path, notes):
    """Each file is read relative to an origin of its own, near its middle."""
    origin = np.array([500_000.0, 5_000_000.0, 300.0])
    frames = [eqx.tree_at(lambda g: g.means, some(), some().means + 40.0 * t) for t in range(3)]
    for t, frame in enumerate(frames):
        write_ply(tmp_path / f"{t}.ply", frame, origin=origin)
    origins = {tuple(read_gaussians(tmp_path / f"{t}.ply")[1].origin) for t in range(3)}
    assert len(origins) == 3
    scene, _ = open_viewable(tmp_path, notes)
    for t, frame in enumerate(frames):
        found = in_world(np.asarray(scene.at(t).means), scene.origin)
        np.testing.assert_allclose(found, np.asarray(frame.means) + origin, rtol=0, atol=1e-5)


def test_frames_of_before_are_kept_and_told(export, tracked, tmp_path):
    out = tmp_path / "frames" / "####.ply"
    assert export(tracked, out)[0] == 0
    before = {file: file.read_bytes() for file in out.parent.iterdir()}
    code, said = export(tracked, out)
    assert (code, "0000.ply: is there already" in said) == (2, True), said
    code, said = export(tracked, out, "--frames=:2", "--overwrite")
    assert (code, "holds 2 more numbered files, such as 0002.ply" in said) == (0, True), said
    assert {file: file.read_bytes() for file in out.parent.iterdir()} == before
