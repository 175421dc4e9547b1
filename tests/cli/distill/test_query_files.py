"""Where `gsjax query` looks for a field's scene and photographs, which files it refuses, and which files it
leaves alone."""

import json
import shutil

import numpy as np
import pytest

from gsjax.io.labels import labels_beside
from gsjax.io.ply import read_ply, write_ply
from tests.cli.distill.conftest import CAN, told_of


@pytest.fixture(scope="module")
def scene(labelled):
    return labelled


def change(field, how):
    """Changes the metadata in field.npz."""
    told = dict(np.load(field / "field.npz"))
    about = json.loads(str(told["about"]))
    how(about)
    np.savez(field / "field.npz", **{**told, "about": np.array(json.dumps(about))})


# where it looks


@pytest.mark.thorough
def test_a_scene_is_found_by_what_is_in_it(gsjax, field, scene, tmp_path):
    """There is another scene now where it was; the run, which was moved whole, has it in canonical/."""
    run = tmp_path / "run"
    (run / "canonical").mkdir(parents=True)
    moved = shutil.move(field, run / "field")
    change(moved, lambda about: about["scene"].update(file=str(run / "scene.ply")))
    gaussians, _ = read_ply(scene[0])
    write_ply(run / "scene.ply", gaussians, antialiased=True)
    for file in (scene[0], labels_beside(scene[0])):
        shutil.copy(file, run / "canonical")
    code, said = gsjax("query", moved, "can", "--camera", 0)
    assert code == 0, said
    assert "has changed since" not in said
    assert told_of(moved)["scene"] == str(run / "canonical" / "scene.ply")
    np.testing.assert_array_equal(read_ply(moved / "query" / "object.ply")[1].labels, CAN)
    # Without it the other scene is taken, with a warning.
    (run / "canonical" / "scene.ply").unlink()
    code, said = gsjax("query", moved, "can", "--camera", 0)
    assert code == 0, said
    assert f"{run / 'scene.ply'} has changed since the field in {moved} was distilled" in said
    (run / "scene.ply").unlink()
    code, said = gsjax("query", moved, "can")
    assert code == 2
    assert "give it with --scene" in said
    code, said = gsjax("query", moved, "can", "--camera", 0, "--scene", scene[0])
    assert code == 0, said
    assert "has changed since" not in said


def test_photographs_are_where_they_are_said_to_be(gsjax, field, pristine, scene, tmp_path):
    change(field, lambda about: about["scene"]["photographs"].update(images=str(tmp_path / "gone")))
    code, said = gsjax("query", field, "can")
    assert code == 0, said
    assert "its photographs cannot be read, so nothing is drawn" in said
    assert "pass the folder that they are in now as --images" in said
    assert not (field / "query" / "masks").exists()
    for options in (("can",), ("--point", "1,1")):
        code, said = gsjax("query", field, *options, "--camera", 0)
        assert code == 2
        assert "--camera: expected photographs, found none" in said
    code, said = gsjax("query", field, "can", "--images", pristine, "--camera", 2)
    assert code == 0, said
    assert [path.name for path in (field / "query" / "masks").iterdir()] == ["2.png"]
    change(field, lambda about: about["scene"].pop("photographs"))
    code, said = gsjax("query", field, "can")
    assert code == 0, said
    assert "field.npz: expected the training photographs' names, found others" in said


# what it refuses


def test_a_field_that_is_damaged_is_refused(gsjax, field):
    with np.load(field / "field.npz") as stored:
        arrays = dict(stored)
    for name, wrong in {"vectors": np.nan, "lift": np.inf}.items():
        np.savez(field / "field.npz", **{**arrays, name: np.full_like(arrays[name], wrong)})
        code, said = gsjax("query", field, "can")
        assert code == 2
        assert name in said
    np.savez(field / "field.npz", **{**arrays, "vectors": arrays["vectors"][1:]})
    code, said = gsjax("query", field, "can")
    assert code == 2
    assert "Gaussians" in said
    (field / "field.npz").write_bytes(b"no archive")
    code, said = gsjax("query", field, "can")
    assert code == 2
    assert "field.npz" in said


def test_a_run_without_a_field_is_told_how_to_get_one(gsjax, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yml").write_text("# gsjax run\nfit: {}\ntest_every: 8\n")
    code, said = gsjax("query", run, "can")
    assert code == 2
    assert f"expected a field, found none; gsjax distill {run} makes one" in said
    (run / "field").mkdir()
    (run / "field" / "config.yml").write_text("# gsjax run\nscene: x\nfeatures: auto\ndistill: {}\n")
    for path in (run, run / "field"):
        code, said = gsjax("query", path, "can")
        assert code == 2
        assert f"{run / 'field'}: expected field.npz, found none yet: it is still being distilled" in said


# what it leaves as it was


def test_a_folder_of_somebody_else_is_left_alone(gsjax, field, tmp_path):
    mine = tmp_path / "mine"
    (mine / "query").mkdir(parents=True)
    shutil.copy(field / "field.npz", mine)
    (mine / "query" / "precious.txt").write_text("mine")
    code, said = gsjax("query", mine, "can")
    assert code == 2
    assert "query: expected nothing, or only what gsjax writes there" in said
    assert "found precious.txt" in said
    assert (mine / "query" / "precious.txt").read_text() == "mine"
    (mine / "query" / "precious.txt").rename(mine / "precious.txt")
    code, said = gsjax("query", mine, "can")
    assert code == 0, said
    assert told_of(mine)["pixels"].keys() == {"0", "1", "2"}  # the file says which photographs there were
    assert sorted(path.name for path in mine.iterdir()) == ["field.npz", "precious.txt", "query"]


@pytest.mark.parametrize("problem", [KeyboardInterrupt, OSError("no space")])
def test_an_answer_that_is_not_whole_leaves_the_one_before(gsjax, field, monkeypatch, problem):
    assert gsjax("query", field, "can", "--camera", 0)[0] == 0
    before = told_of(field)

    def stopped(*args, **options):
        raise problem

    monkeypatch.setattr("gsjax.engine.distill.query.in_rows", stopped)
    code, _ = gsjax("query", field, "carton", "--camera", 0)
    assert code == (130 if problem is KeyboardInterrupt else 2)
    assert told_of(field) == before
    assert (field / "query" / "overview.png").is_file()
    assert sorted(path.name for path in field.iterdir()) == ["config.yml", "field.npz", "query"]


def test_a_photograph_that_cannot_be_read_is_done_without(gsjax, field, pristine, tmp_path):
    images = shutil.copytree(pristine, tmp_path / "images")
    for picture in (images / "ims").rglob("000000.*"):
        picture.write_bytes(b"no picture")
    code, said = gsjax("query", field, "can", "--images", images)
    assert code == 0, said
    assert "overview.png shows a render in place of a photograph" in said
    assert (field / "query" / "overview.png").is_file()
