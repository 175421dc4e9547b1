"""`gsjax edit` with edits that cannot be done, and on folders that are no sound run."""

import numpy as np
import pytest

from gsjax.io.ply import read_ply, write_ply
from gsjax.scene.gaussians import take
from tests.cli.parts.test_edit import moved_away, write_run

SPEED = ("--op", "speed:parts=drawer,factor=2")


@pytest.fixture
def run(tmp_path):
    return write_run(tmp_path / "run")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("gone.yaml",), "gone.yaml: no such file or directory"),
        (
            ("--op", "speed:parts=cup,factor=2"),
            "expected one of background (0), part 1 (1), part 2 (2), drawer",
        ),
        (("--op", "speed:parts=drawr,factor=2"), "edit 1 (speed): parts:"),
        (("--op", "speed:parts=drawr,factor=2"), "did you mean 'drawer'?"),
        (("--op", "sped:parts=1"), "--op 'sped:parts=1': edit 1: op: expected one of isolate"),
        ((*SPEED, "--op", "move:parts=1"), "--op 'move:parts=1': edit 2 (move): by: expected metres"),
        ((*SPEED, "--camera", "7"), "has no camera 7; it has [0, 1, 2]."),
        (("--op", "composite:parts=1,from_run=gone"), "gone: expected the folder of a run of `gsjax parts`"),
    ],
)
def test_what_cannot_be_done(gsjax, run, options, says):
    code, said = gsjax("edit", run, *options)
    assert code == 2
    assert says in said
    assert not (run / "edit").exists()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"edits: [", "bad.yaml: expected YAML, found a fault in line"),
        (b"speed: 2", "bad.yaml: speed: expected one of fps, length, edits"),
        (b"edits: [{op: speed, parts: 1}]", "bad.yaml: edits: edit 1 (speed): factor: expected a factor"),
        (b"\xff\xfe\x00", "bad.yaml: expected a YAML file of edits, found no text"),
    ],
)
def test_a_script_that_is_none(gsjax, run, tmp_path, text, says):
    (tmp_path / "bad.yaml").write_bytes(text)
    code, said = gsjax("edit", run, tmp_path / "bad.yaml")
    assert code == 2
    assert says in said


@pytest.mark.parametrize(
    ("break_it", "says"),
    [
        (lambda run: (run / "config.yml").write_text("a: 1"), "config.yml begins with '# gsjax run'"),
        (lambda run: (run / "config.yml").write_text("# gsjax run\na: 1"), "expected a run's settings"),
        (
            lambda run: (run / "parts.npz").unlink(),
            "expected a complete run of `gsjax parts`, found no parts.npz",
        ),
        (lambda run: _of_track(run), "expected a run of `gsjax parts`, found one of `gsjax track`; name"),
        (lambda run: (run / "parts.npz").write_bytes(b"x"), "parts.npz: expected plain arrays"),
        (lambda run: np.savez(run / "parts.npz", anchor=0), "expected an array weights, found anchor"),
        (lambda run: (run / "metrics.json").write_text("[]"), "metrics.json: expected a run's scores"),
        (
            lambda run: _with_fewer(run),
            "expected 200 Gaussians as in parts.npz, found 199 drawable Gaussians of 199",
        ),
        (lambda run: moved_away(run), "its recording cannot be opened"),
    ],
)
def test_a_run_that_is_none(gsjax, run, break_it, says):
    break_it(run)
    code, said = gsjax("edit", run, *SPEED)
    assert code == 2
    assert says in said


@pytest.mark.parametrize("file", [True, False])
def test_what_is_no_film_is_left_alone(gsjax, run, tmp_path, file):
    out = tmp_path / "photos"
    if not file:
        out.mkdir()
    mine = out if file else out / "video.mp4"
    mine.write_text("mine")
    code, said = gsjax("edit", run, *SPEED, "--out", out, "--overwrite")
    assert code == 2
    assert ("found a file" if file else "found other files") in said
    assert mine.read_text() == "mine"


def test_parts_are_listed_once_they_are_scored(gsjax, run):
    (run / "metrics.json").unlink()
    code, said = gsjax("edit", run)
    assert code == 2
    assert "expected a scored run, found no metrics.json; finish it with --resume" in said


def _of_track(run):
    (run / "parts.npz").unlink()
    (run / "metrics.json").write_text('{"kind": "track"}')


def _with_fewer(run):
    gaussians, _ = read_ply(run / "scene.ply")
    write_ply(run / "scene.ply", take(gaussians, np.arange(199)))
