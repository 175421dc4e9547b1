"""`gsjax view` of a scene with a field: what can be queried in the viewer, and which answers are saved."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from gsjax.engine.distill.saved import Locations
from gsjax.engine.teaching.source import Source
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import read_ply, write_ply
from gsjax.perception.codebook import ClassCodebook
from tests.cli.conftest import write_made_field
from tests.cli.view.conftest import some

pytest.importorskip("viser", reason="viser is not installed")


NAMES = {1: "table", 2: "can"}
CODES = np.stack([ClassCodebook(NAMES).embed_text(name) for name in NAMES.values()])


@pytest.fixture
def asked(fitted) -> Path:
    """A field for the fit, in which odd Gaussians are a can."""
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
    monkeypatch.setattr("gsjax.engine.files.read_gaussians", lambda file: read.append(file) or read_ply(file))
    open_viewable(fitted, notes)
    assert read == [fitted / "scene.ply"]


def test_a_field_alone_is_asked_of_the_scene_that_is_named(fitted, asked, tmp_path, notes, view):
    write_ply(fitted / "scene.ply", some(), labels=np.arange(30) % 3, antialiased=True)  # not as it was
    scene, _ = open_viewable(fitted, notes)
    assert any("has changed since the field in" in note for note in notes.all)
    mine = tmp_path / "mine"
    mine.mkdir()
    shutil.copy(asked / "field.npz", mine)
    for ending in (".ply", "_labels.npz"):
        shutil.move(fitted / f"scene{ending}", tmp_path / f"moved{ending}")
    code, said = view(mine, "--port", 0)
    assert code == 2
    assert "give it with --scene" in said
    code, said = view(mine, "--port", 0, "--scene", tmp_path / "moved.ply")
    assert code == 130, said
    assert "can be queried" in said
    scene, folder = open_viewable(mine, notes, Locations(tmp_path / "moved.ply"))
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

    monkeypatch.setattr("gsjax.engine.query.write_scene", full)
    with pytest.raises(OSError, match="no space"):
        asking.save(selected, "x", 0)
    assert sorted(asked.joinpath("extracted").glob("*.ply")) == paths


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
        with pytest.raises(ValueError, match="give its folder with --weights"):
            asking.ask("can", 0)
        assert open_viewable(fitted, notes, Locations(weights=Path("x")))[0].asking.hint == "Any words"


def test_a_field_of_another_scene_is_not_asked(fitted, asked, tmp_path, notes):
    shutil.move(fitted / "scene.ply", tmp_path / "first.ply")
    write_ply(fitted / "scene.ply", some(20))
    told = dict(np.load(asked / "field.npz"))
    np.savez(asked / "field.npz", **{**told, "vectors": told["vectors"][:7]})
    scene, _ = open_viewable(fitted, notes)
    assert (scene.gaussians.num, scene.asking) == (20, None)
    assert any("its field cannot be queried" in note for note in notes.all)


def test_what_was_tracked_is_asked_in_any_frame(tracked, notes):
    source = Source("classes", NAMES)
    labels = np.arange(30) % 2
    field = write_made_field(tracked / "field", tracked / "scene.ply", None, source, labels, CODES)
    scene, _ = open_viewable(tracked, notes)
    assert scene.motion is not None
    answers = [scene.asking.ask("can", frame) for frame in range(2)]
    np.testing.assert_array_equal(answers[0].scores, answers[1].scores)
    assert open_viewable(field, notes)[0].asking is not None
    told = dict(np.load(field / "field.npz"))
    np.savez(field / "field.npz", **{**told, "vectors": told["vectors"][:7]})
    scene, _ = open_viewable(tracked, notes)
    assert scene.asking is None
    assert any("its field cannot be queried" in note for note in notes.all)


def test_a_better_field_that_comes_meanwhile_answers(fitted, asked, notes):
    """Like the one that gradient descent writes after the solution, while the viewer is open."""
    asking = open_viewable(fitted, notes)[0].asking
    before = asking.ask("can", 0).scores
    told = dict(np.load(asked / "field.npz"))
    np.savez(asked / "better.npz", **{**told, "vectors": 1 - told["vectors"]})
    (asked / "better.npz").replace(asked / "field.npz")
    after = asking.ask("can", 0).scores
    assert ((before > 0.5) != (after > 0.5)).all()
    np.testing.assert_array_equal(asking.like(4, 0).scores, asking.like(4, 0).scores)


def test_parts_say_where_their_field_is_asked(tracked, notes):
    field = tracked / "field"
    field.mkdir()
    (field / "field.npz").touch()
    (tracked / "parts.npz").touch()
    with pytest.raises(ValueError, match=r"parts\.npz"):  # it is empty; the note before that counts here
        open_viewable(tracked, notes)
    assert any(f"gsjax view {field} shows the scene of its field" in note for note in notes.all)
