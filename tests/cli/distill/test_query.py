"""`gsjax query` on a field: what it finds, writes and refuses.

The fields are made up, with one row for each class; test_ply.py queries a distilled one.
"""

import json
import shutil
from functools import partial

import cv2
import equinox as eqx
import numpy as np
import pytest

from gsjax.engine.distill import query as field_query
from gsjax.engine.teaching.source import Source
from gsjax.io.ply import read_ply, write_ply
from gsjax.perception.closed_vocabulary import ClosedVocabulary
from gsjax.perception.codebook import ClassCodebook
from gsjax.viz.viewer import drawing
from tests.cli.conftest import LABELS, write_made_field
from tests.cli.distill.conftest import CAN, NAMES, found_of, told_of

CARTON = 2


@pytest.fixture(scope="module")
def scene(labelled):
    return labelled


@pytest.fixture(scope="module")
def closed(pristine, scene, tmp_path_factory):
    """A made-up field of the closed vocabulary: colours, outlines and names."""
    picture = cv2.imread(str(next((pristine / "ims" / "0").iterdir())))[..., ::-1]
    seen = cv2.imread(str(pristine / "seg" / "0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    vectors = ClosedVocabulary(NAMES, sizes=False).embed_objects(
        picture, seen.astype(np.int32) + 1, len(NAMES)
    )
    return write_made_field(
        tmp_path_factory.mktemp("fields") / "closed",
        scene[0],
        pristine,
        Source("closed", NAMES),
        scene[1],
        vectors,
    )


def panels(folder):
    """The panels of overview.png, without the captions at their top."""
    picture = cv2.imread(str(folder / "overview.png"))
    high, wide = 240, 320
    assert picture.shape[0] == 2 * high
    places = [(y, x) for y in (0, high) for x in range(0, picture.shape[1], wide)]
    return [picture[y + 40 : y + high, x : x + wide] for y, x in places]


# what it finds


def test_an_answer_goes_nowhere_where_something_would_be_lost(gsjax, closed, tmp_path, monkeypatch):
    field, other, here = shutil.copytree(closed, tmp_path / "closed"), tmp_path / "other", tmp_path / "here"
    for folder, file in ((other, "query.json"), (other, ".git"), (here, "query.json")):
        folder.mkdir(exist_ok=True)
        (folder / file).write_text("{}")
    monkeypatch.chdir(here)
    for out, found in ((field, "other files"), (other, "other files"), (".", "the current one")):
        code, said = gsjax("query", field, "can", "--out", out)
        assert code == 2
        assert f"--out {out}: expected " in said
        assert found in said
    code, said = gsjax("query", field, "can", "--no-pictures", "--camera", "0")
    assert (code, "--camera: expected --point" in said) == (2, True)


@pytest.mark.thorough
def test_an_answer_elsewhere_and_without_pictures(gsjax, closed, tmp_path):
    field, out = shutil.copytree(closed, tmp_path / "closed"), tmp_path / "answers" / "can"
    code, said = gsjax("query", field, "can", "--no-pictures", "--out", out)
    assert code == 0, said
    assert f"query {out}: selection.npz, object.ply" in said
    assert "overview.png" not in said
    assert not (field / "query").exists()
    assert {file.suffix for file in out.iterdir()} == {".json", ".npz", ".ply"}
    assert json.loads((out / "query.json").read_text())["pixels"] is None
    elsewhere = found_of(field, out)
    assert gsjax("query", field, "can")[0] == 0
    np.testing.assert_array_equal(found_of(field)["indices"], elsewhere["indices"])


@pytest.mark.thorough
def test_a_text_within_another_finds_what_both_mean(gsjax, field, closed, scene, tmp_path):
    """In the field of colours and names, the blue Gaussians of the can; there is no ball within the can."""
    closed = shutil.copytree(closed, tmp_path / "closed")
    assert gsjax("query", closed, "can")[0] == 0
    cans = found_of(closed)["indices"]
    assert gsjax("query", closed, "blue")[0] == 0
    blues = found_of(closed)["indices"]
    code, said = gsjax("query", closed, "blue", "--within", "can")
    assert code == 0, said
    assert "'blue' within 'can'" in said
    both = np.intersect1d(cans, blues)
    assert len(both) > 0
    np.testing.assert_array_equal(found_of(closed)["indices"], both)
    code, said = gsjax("query", field, "ball", "--within", "can")
    assert code == 2
    assert "'ball' within 'can' matches nothing in this scene" in said
    assert gsjax("query", field, "ball", "--within", "can", "--top", "5")[0] == 0
    best = json.loads((field / "query" / "query.json").read_text())["best_score"]
    assert best == pytest.approx(found_of(field)["scores"].max(), abs=1e-5)  # not that of the ball


@pytest.mark.thorough
def test_a_query_is_of_the_level_that_it_fits_best_or_of_a_given_one(gsjax, pristine, scene, tmp_path):
    """On the smallest level a can is a can; on the largest all objects but the background are one."""
    book = ClassCodebook(NAMES | {9: "everything"})
    small = np.stack([book.embed_text(name) for name in LABELS.values()])
    large = np.stack([book.embed_text("everything" if label else LABELS[label]) for label in LABELS])
    vectors = np.concatenate([small, (2 * small + large) / 3, large], axis=1)
    source = Source("classes", NAMES | {9: "everything"}, None, ("small", "medium", "large"))
    levels = write_made_field(tmp_path / "levels", scene[0], pristine, source, scene[1], vectors)
    labels = scene[1]
    for options, level, wanted in (
        (("can",), "small", labels == CAN),
        (("everything",), "large", labels > 0),
        (("can", "--level", "medium"), "medium", labels == CAN),
        (("can", "--level", "large", "--threshold", 0), "large", labels >= 0),
    ):
        code, said = gsjax("query", levels, *options)
        assert code == 0, said
        assert f"on level {level}: " in said
        assert told_of(levels)["level"] == level
        np.testing.assert_array_equal(found_of(levels)["indices"], np.flatnonzero(wanted))
    picture = cv2.imread(str(pristine / "seg" / "0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    y, x = np.argwhere(cv2.erode((picture == CAN).astype(np.uint8), np.ones((5, 5))))[0]
    at = ("--point", f"{x},{y}", "--camera", 0)
    for options, level, name in (((), "small", "can"), (("--level", "large"), "large", "everything")):
        code, said = gsjax("query", levels, *at, *options)
        assert code == 0, said
        assert f"'{name}', on level {level}: " in said


def test_a_field_is_opened_in_python(field, scene, tmp_path):
    from gsjax import open_field

    found = open_field(field)
    np.testing.assert_array_equal(np.asarray(found.query("can")) > 0.5, scene[1] == CAN)
    with pytest.raises(FileNotFoundError, match=r"expected a field \(field\.npz\), found none"):
        open_field(tmp_path / "nothing")
    gaussians = read_ply(scene[0])[0]
    write_ply(
        tmp_path / "other.ply", eqx.tree_at(lambda g: g.means, gaussians, np.asarray(gaussians.means) + 1)
    )
    with pytest.warns(UserWarning, match="has changed since the field"):
        open_field(field, tmp_path / "other.ply")


def test_a_level_that_a_field_has_not(gsjax, field):
    code, said = gsjax("query", field, "can", "--level", "small")
    assert code == 2
    assert "--level: expected none, as this field has one level (gsjax distill --level each)" in said


def test_the_best_few_are_found_whatever_their_scores(gsjax, closed, tmp_path):
    closed = shutil.copytree(closed, tmp_path / "closed")
    code, said = gsjax("query", closed, "red", "--top", 7)
    assert code == 0, said
    found, told = found_of(closed), told_of(closed)
    assert (told["rule"], told["top"]) == ("the 7 best", 7)
    assert "at least" in said
    assert len(found["indices"]) == 7  # though more have the same score
    rest = np.delete(found["all_scores"], found["indices"])
    assert np.nanmax(rest) <= found["scores"].min()
    for options, words in (((0,), "found 0"), ((5, "--threshold", 0.5), "found --threshold too")):
        code, said = gsjax("query", closed, "red", "--top", *options)
        assert code == 2
        assert f"--top: expected 1 Gaussian or more, and no --threshold, {words}" in said


def test_a_text_gives_gaussians_masks_and_scenes(gsjax, field, scene, pristine):
    code, said = gsjax("query", field, "can", "--move", 0, 0, 0.5)
    assert code == 0, said
    folder, (whole, labels) = field / "query", (read_ply(scene[0])[0], scene[1])
    told, found = told_of(field), found_of(field)
    np.testing.assert_array_equal(found["indices"], np.flatnonzero(labels == CAN))
    rows = found["indices"]
    assert told["gaussians"] == len(found["scores"])
    assert (found["scores"] > told["threshold"]).all()
    assert len(found["all_scores"]) == whole.num
    np.testing.assert_array_equal(found["means"], np.asarray(whole.means)[rows])
    parts = {n: read_ply(folder / f"{n}.ply") for n in ("object", "without", "recolored", "moved")}
    for name, kept in (("object", labels == CAN), ("without", labels != CAN), ("moved", labels >= 0)):
        np.testing.assert_array_equal(parts[name][1].labels, labels[kept], err_msg=name)
    np.testing.assert_array_equal(np.asarray(parts["object"][0].means), found["means"])
    gone = np.asarray(parts["moved"][0].means) - np.asarray(whole.means)
    np.testing.assert_allclose(gone[rows], np.tile([0, 0, 0.5], (len(rows), 1)), atol=1e-6)
    assert not np.delete(gone, rows, axis=0).any()
    changed = (np.asarray(parts["recolored"][0].sh0) != np.asarray(whole.sh0)).any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(changed), rows)
    mask = cv2.imread(str(folder / "masks" / "0.png"), cv2.IMREAD_UNCHANGED) == 255
    truth = cv2.imread(str(pristine / "seg" / "0" / "000000.png"), cv2.IMREAD_UNCHANGED) == CAN
    assert (mask & truth).sum() > 0.6 * (mask | truth).sum()
    assert told["pixels"] == {camera: told["pixels"][camera] for camera in ("0", "1", "2")}
    assert told["pixels"]["0"] == mask.sum()
    places = panels(folder)
    assert len(places) == 6
    assert all(place.any() for place in places)
    # The summary in the terminal.
    center = ", ".join(f"{x:.3f}" for x in found["means"].mean(0))
    assert f"found 'can': {len(rows):,} of {whole.num:,} Gaussians centre {center} m size" in said
    assert "score above 0.500 (better than each negative)" in said
    assert "seen in 3 of 3 photographs" in said
    assert "s, of which the query took" in said


def test_the_scene_is_read_once_and_drawn_by_one_program(gsjax, field, scene, monkeypatch):
    """The scene without the object keeps its number of Gaussians, so that one program draws both."""
    drawers, drawer, read = [], field_query.Drawer, []

    def kept(*args, **options):
        drawers.append(drawer(*args, **options))
        return drawers[-1]

    monkeypatch.setattr(field_query, "Drawer", kept)
    # A new function object: JAX would reuse what other tests compiled for the same one.
    monkeypatch.setattr(drawing, "_draw", partial(drawing._draw))
    for module in ("gsjax.engine.files", "gsjax.engine.distill.scene"):
        monkeypatch.setattr(f"{module}.read_gaussians", lambda file: read.append(file) or read_ply(file))
    code, said = gsjax("query", field, "carton", "--move", 0, 0, 0.01)
    assert code == 0, said
    assert drawers[0]._program._cache_size() == 1
    assert read == [scene[0]]


def test_a_point_means_the_thing_that_it_shows(gsjax, field, scene, pristine):
    truth = cv2.imread(str(pristine / "seg" / "1" / "000000.png"), cv2.IMREAD_UNCHANGED)
    inside = cv2.erode((truth == CARTON).astype(np.uint8), np.ones((3, 3)))
    y, x = (int(places[len(places) // 2]) for places in np.nonzero(inside))
    code, said = gsjax("query", field, "--point", f"{x},{y}", "--camera", 1)
    assert code == 0, said
    np.testing.assert_array_equal(found_of(field)["indices"], np.flatnonzero(scene[1] == CARTON))
    told = told_of(field)
    assert sorted(told["against"]) == sorted(set(LABELS.values()) - {"carton"})


@pytest.mark.thorough
def test_negatives_are_what_it_is_held_against(gsjax, field, closed, tmp_path):
    assert gsjax("query", field, "can", "--negatives", "ball", "--threshold", 0.9)[0] == 0
    told = told_of(field)
    assert (told["against"], told["rule"]) == (["ball"], "given")
    code, said = gsjax("query", field, "can", "--negatives", "spoon")
    assert code == 2
    assert "'spoon'" in said
    closed = shutil.copytree(closed, tmp_path / "closed")
    point = ("--point", "40,30", "--camera", 0)
    assert gsjax("query", closed, *point)[0] == 0
    assert told_of(closed)["against"] == []
    assert gsjax("query", closed, *point, "--negatives", "red", "--threshold", 0.1)[0] == 0
    assert told_of(closed)["against"] == ["red"]


def test_a_picture_of_a_red_thing_means_red_things(gsjax, closed, scene, tmp_path):
    """Whatever the scene has names for: a thing in a picture has none, and is not the background."""
    field = shutil.copytree(closed, tmp_path / "closed")
    assert gsjax("query", field, "red", "--threshold", 0.0)[0] == 0
    by_word = found_of(field)["all_scores"]
    assert scene[1][by_word.argmax()] == CARTON
    picture = np.zeros((20, 20, 3), np.uint8)
    picture[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), picture)
    cv2.imwrite(str(tmp_path / "deep.png"), picture.astype(np.uint16) * 257)
    answers = []
    for name in ("red.png", "deep.png"):  # 8 and 16 bits
        code, said = gsjax("query", field, "--image", tmp_path / name)
        assert code == 0, said
        answers.append(found_of(field)["all_scores"])
    np.testing.assert_array_equal(*answers)
    assert scene[1][answers[0].argmax()] == CARTON
    assert CARTON in scene[1][found_of(field)["indices"]]
    code, said = gsjax("query", field, "spoon")
    assert code == 2
    assert "'spoon'" in said


def test_everything_is_an_answer_with_a_warning(gsjax, field):
    code, said = gsjax("query", field, "can", "--threshold", 0)
    assert code == 0
    assert "means all" in said
    assert not (field / "query" / "without.ply").exists()
    assert len(panels(field / "query")) == 4  # nor is there a picture of it


@pytest.mark.thorough
def test_rows_that_cannot_be_drawn_are_counted_and_rows_are_the_files(gsjax, pristine, scene, tmp_path):
    gaussians, _ = read_ply(scene[0])
    means = np.array(gaussians.means)
    lost = np.flatnonzero(scene[1] == CAN)[:2]
    means[lost, 0] = np.nan
    file, book = tmp_path / "scene.ply", ClassCodebook(NAMES)
    write_ply(file, eqx.tree_at(lambda g: g.means, gaussians, means), labels=scene[1])
    vectors = np.stack([book.embed_text(name) for name in LABELS.values()])
    left = np.delete(scene[1], lost)
    field = write_made_field(tmp_path / "field", file, pristine, Source("classes", NAMES), left, vectors)
    code, said = gsjax("query", field, "can", "--camera", 0)
    assert code == 0, said
    assert f"2 of {len(means)} Gaussians cannot be drawn" in said
    found = found_of(field)
    np.testing.assert_array_equal(found["indices"], np.flatnonzero(scene[1] == CAN)[2:])
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found["all_scores"])), lost)
    assert read_ply(field / "query" / "without.ply")[0].num == (left != CAN).sum()


# what it refuses


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("one of TEXT, --image and --point",)),
        (("can", "--point", "1,1"), ("found 2",)),
        (("cannon",), ("'cannon'", "carton")),
        (("can", "--threshold", 0.99999), ("best score", "--threshold")),
        (("can", "--threshold", 1), ("--threshold: expected a finite number below 1", "found 1")),
        (("can", "--threshold", "nan"), ("--threshold: expected a finite number", "found nan")),
        (("can", "--threshold", "-inf"), ("--threshold: expected a finite number", "found -inf")),
        (("--point", "1,1"), ("--camera",)),
        (("--point", "x", "--camera", "0"), ("X,Y", "'x'")),
        (("--point", "999,1", "--camera", "0"), ("80x60", "999")),
        (("--point", "1,1", "--camera", "7"), ("0, 1, 2", "7")),
        (("can", "--camera", "7"), ("--camera: expected one of 0, 1, 2, found 7",)),
        (("--image", "nowhere.png"), ("by name",)),
        (("can", "--encoder", "clip"), ("--encoder",)),
        (("can", "--color", 2, 0, 0), ("--color",)),
        (("can", "--move", "nan", 0, 0), ("--move: expected three finite numbers, found nan 0 0",)),
        (("can", "--weights", "x"), ("--weights", "classes")),
        (("can", "--scene", "nowhere.ply"), ("nowhere.ply", "found no file")),
        (("can", "--images", "nowhere"), ("--images nowhere",)),
    ],
)
def test_a_question_that_cannot_be_answered_leaves_the_last_answer(gsjax, field, options, words):
    (field / "query").mkdir()
    (field / "query" / "query.json").write_text("{}")
    code, said = gsjax("query", field, *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert said.endswith(f"({field / 'query'} still has an earlier answer)")
    assert (field / "query" / "query.json").read_text() == "{}"
