"""`gsjax distill` on bad folders, options and views, and runs that are resumed with other data."""

import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from gsjax.engine.distill.run import Options, with_paths
from gsjax.engine.teaching import teaching as field_teacher
from gsjax.io.ply import read_ply, write_ply
from tests.cli.distill.conftest import SMALL, metrics


def test_a_run_without_photographs_of_one_scene_is_refused(gsjax, scene, tmp_path):
    settings = {"dataset": "simulated:tissue", "deform": {}, "tools": "draw"}
    (tmp_path / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
    shutil.copy(scene, tmp_path / "scene.ply")
    code, said = gsjax("distill", tmp_path)
    assert code == 2
    assert "found one of `gsjax deform`" in said


@pytest.mark.thorough
@pytest.mark.parametrize("place", ["", "canonical"])
def test_a_field_never_replaces_its_scene(gsjax, pristine, scene, tmp_path, place):
    run = tmp_path / "run"
    (run / place).mkdir(parents=True)
    settings = {"dataset": str(pristine), "frames": "0:1", "test_every": 8, "fit": {}}
    for folder in {run, run / place}:
        (folder / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(settings))
    file = Path(shutil.copy(scene, run / place / "scene.ply"))
    images = ("--images", pristine, "--frames", "0:1", "--test-every", 0)
    for told in ((run,), (file, *images)):
        for out in {run, run / place}:
            code, said = gsjax("distill", *told, "--out", out, "--overwrite")
            assert code == 2
            assert f"--out {out}: expected a folder for the field alone" in said
    linked = tmp_path / "linked"
    shutil.copytree(run, linked)
    (linked / place / "scene.ply").unlink()
    (linked / place / "scene.ply").symlink_to(scene)
    assert gsjax("distill", linked, "--out", linked / place, "--overwrite")[0] == 2
    assert file.is_file()
    assert (linked / place / "scene.ply").is_symlink()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--features", "clip", "--weights", "nowhere"), ("--weights nowhere", "found nothing there")),
        (("--features", "clip", "--weights", "."), ("--weights", "it lacks config.json")),
        (("--weights", "."), ("--weights", "--features clip", "found auto")),
        (("--sam", "nowhere"), ("--sam nowhere", "found nothing there")),
        (("--scale", 0.01), ("--scale 0.01", "80x60", "1x1")),
        (("--second", "maskclip"), ("--second maskclip", "--features clip", "found auto")),
        (("--level", "small"), ("--level small", "--features FOLDER")),
        (("--level", "each"), ("--level each", "--features FOLDER", "or --sam")),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is(
    gsjax, monkeypatch, pristine, scene, tmp_path, options, words
):
    def never(*args):
        raise AssertionError

    monkeypatch.setattr(field_teacher, "_names", never)
    monkeypatch.chdir(tmp_path)
    told = ("--out", "field", "--images", pristine, "--frames", "0:1", "--test-every", 0)
    code, said = gsjax("distill", scene, *told, *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert not Path("field").exists()


@pytest.mark.thorough
def test_views_that_are_odd_cost_nothing_but_themselves(gsjax, recording, scene, tmp_path):
    shutil.rmtree(recording / "seg/1")
    (recording / "ims/2/000000.png").write_bytes(b"no picture")
    seen = cv2.imread(str(recording / "seg/2/000001.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(recording / "seg/2/000001.png"), np.where(seen == 2, 77, np.where(seen == 3, 0, seen)))
    told = ("--images", recording, "--frames", "0:2", "--eval-cameras", 2, "--features", "closed", *SMALL)
    field = tmp_path / "my field"
    code, said = gsjax("distill", scene, "--out", field, *told, "--distill.iterations", 2)
    assert code == 0, said
    assert f"query it gsjax query {shlex.quote(str(field))} TEXT" in " ".join(said.split())
    assert "no mask says anything teach nothing: 1/0, 1/1" in said
    assert said.count("teach nothing") == 1
    found = metrics(field)
    assert found["views"] == {"taught": 2, "held_out": 2}
    assert [row["cosine"] is None for row in found["scores"]] == [True, False]
    assert any("2/0 was not compared" in n and "ims/2/000000.png" in n for n in found["notes"])
    assert all((field / row["picture"]).is_file() for row in found["scores"])


@pytest.mark.thorough
def test_a_run_goes_on_with_what_it_was_begun_with_or_not_at_all(
    gsjax, interrupted, recording, scene, tmp_path
):
    file, out = Path(shutil.copy(scene, tmp_path / "scene.ply")), tmp_path / "field"
    told = (
        "distill",
        file,
        "--out",
        out,
        "--images",
        recording,
        "--frames",
        "0:1",
        "--test-every",
        0,
        *SMALL,
    )
    told += ("--distill.iterations", 20)
    with interrupted(5):
        assert gsjax(*told)[0] == 130
    before, mask = (out / "field.npz").read_bytes(), recording / "seg/0/000000.png"
    gaussians = read_ply(file)[0]
    write_ply(file, replace(gaussians, means=gaussians.means + 0.01))
    code, said = gsjax(*told, "--resume")
    assert code == 2
    assert f"--resume: {file}: expected the same as when the run in {out} was" in said
    shutil.copy(scene, file)
    kept = mask.read_bytes()
    cv2.imwrite(str(mask), cv2.imread(str(mask), cv2.IMREAD_UNCHANGED)[:, ::-1])
    code, said = gsjax(*told, "--resume")
    assert code == 2
    assert "--resume: the teacher's features of photographs, and their poses" in said
    assert (out / "field.npz").read_bytes() == before
    mask.write_bytes(kept)
    assert gsjax(*told, "--resume")[0] == 0


@pytest.mark.thorough
def test_a_run_is_told_by_what_paths_mean_not_by_how_they_are_typed(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("features", "clip", "sam"):
        (tmp_path / name).mkdir()

    def settings(base):
        return with_paths(Options(base / "scene.ply", features=str(base / "features"), sam=base / "sam"))

    assert settings(Path()) == settings(tmp_path)
    named = with_paths(Options(Path("run"), features="clip", weights=Path("clip")))
    assert (named.features, named.weights) == ("clip", tmp_path / "clip")
