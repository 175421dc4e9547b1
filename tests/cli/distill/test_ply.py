"""`gsjax distill` on a PLY file of the built-in scene, taught by the masks of its first frame, and queries of
what it learned. test_query.py tests what else `gsjax query` does."""

import json
import os
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import yaml

from gsjax.cli import main
from gsjax.engine.distill import run as distill_run
from gsjax.engine.distill.scene import SceneOptions, open_field_scene
from gsjax.io.scenes import read_gaussians, write_gaussians

SMALL = (
    "--distill.grid.levels",
    "4",
    "--distill.grid.most-resolution",
    "32",
    "--distill.grid.log2-entries",
    "12",
)
SMALL += ("--distill.grid.hidden", "16", "--distill.channels", "16", "--distill.contrast-patch", "8")
SMALL += ("--distill.rates.table", "0.1", "--distill.rates.layers", "0.01", "--distill.rates.lift", "0.02")
TABLE = ("--distill.encoding", "table")  # learns in fewer steps
STEPS = 200


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory):
    """A cache of features for these tests alone."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setattr("gsjax.engine.teaching.cache.user_cache", lambda: folder)
        yield folder


def images(pristine):
    return ("--images", pristine, "--frames", "0:1", "--test-every", "0")


@pytest.fixture(scope="module")
def distilled(pristine, scene, tmp_path_factory):
    """A field distilled from the classes of the recording's masks."""
    out = tmp_path_factory.mktemp("fields") / "field"
    steps = ("--preset", "paper", "--distill.iterations", STEPS, *TABLE)
    assert main([str(a) for a in ("distill", scene, "--out", out, *images(pristine), *SMALL, *steps)]) == 0
    return out


@pytest.fixture
def field(distilled, tmp_path):
    """A copy of `distilled` to query and to corrupt."""
    return shutil.copytree(distilled, tmp_path / "field")


def test_a_file_that_says_it_is_antialiased_is_drawn_so(pristine, scene, tmp_path):
    gaussians, _ = read_gaussians(scene)
    for antialiased in (False, True):
        write_gaussians(tmp_path / "scene.spz", gaussians, antialiased=antialiased)
        opened = open_field_scene(SceneOptions(tmp_path / "scene.spz", str(pristine), frames="0:1"))
        assert opened.gaussians.num == gaussians.num
        assert opened.rasterize_mode == ("antialiased" if antialiased else "classic")


@pytest.mark.thorough
def test_a_distillation_writes_all_that_it_promises(distilled):
    found = json.loads((distilled / "metrics.json").read_text())
    assert (found["kind"], found["complete"], found["steps"]) == ("distill", True, STEPS)
    assert found["features"] == "classes"
    assert found["masks"] == "files"
    assert found["test"]["miou_3d"] > 0.5
    assert found["test"]["cosine"] > 0.7
    assert {row["class"] for row in found["classes"]} >= {"can", "carton", "ball", "block"}
    lines = [json.loads(line) for line in (distilled / "metrics.jsonl").read_text().splitlines()]
    assert lines[-1]["step"] == STEPS
    assert lines[-1]["cos"] < 0.5 * lines[0]["cos"]
    assert "IoU, 3D query" in (distilled / "report.html").read_text()
    assert not (distilled / "resume").exists()
    assert list((distilled / "renders" / "taught").glob("*.png"))


def _metrics(field):
    return json.loads((field / "metrics.json").read_text())


def _told(run):
    return json.loads((run / "query" / "query.json").read_text())


@pytest.mark.thorough
@pytest.mark.parametrize("preset", ["vote", "solve"])
def test_a_field_without_descent_takes_passes_over_the_views(gsjax, pristine, scene, tmp_path, preset):
    """It has one vector for each class, and they name most of what the masks show."""
    out = tmp_path / "field"
    code, said = gsjax("distill", scene, "--out", out, *images(pristine), "--preset", preset)
    assert code == 0, said
    found = _metrics(out)
    assert (found["preset"], found["steps"]) == (preset, 3 if preset == "vote" else 18)
    assert found["test"]["miou_3d"] > 0.6
    assert found["trained"] == found["num_gaussians"] * 6 + 512 * 6
    assert gsjax("query", out, "can")[0] == 0


@pytest.mark.slow
def test_the_solution_can_be_asked_while_it_is_trained(gsjax, pristine, scene, tmp_path, monkeypatch):
    """By another process, as a user does; a second distillation into the folder is refused meanwhile."""
    write, written = distill_run.write_field, []
    out, told = tmp_path / "field", ("--preset", "field", "--distill.iterations", 3)
    distill = ("distill", scene, "--out", out, *images(pristine), *told)

    def elsewhere(*words) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "gsjax.cli", *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True)

    def watched(path, result):
        write(path, result)
        asked, again = elsewhere("query", out, "can", "--no-pictures"), elsewhere(*distill, "--overwrite")
        assert (asked.returncode, again.returncode) == (0, 2), asked.stderr + again.stderr
        assert f"found process {os.getpid()}, which has been writing there" in " ".join(again.stderr.split())
        written.append(type(result.field.encoding).__name__)

    monkeypatch.setattr(distill_run, "write_field", watched)
    code, said = gsjax(*distill)
    assert code == 0, said
    assert written == ["ArrayImpl", "FeatureGrid"]


@pytest.mark.thorough
def test_what_was_distilled_can_be_asked(gsjax, field, pristine):
    code, said = gsjax("query", field, "can")
    assert code == 0, said
    mask = cv2.imread(str(field / "query" / "masks" / "0.png"), cv2.IMREAD_UNCHANGED) == 255
    truth = cv2.imread(str(pristine / "seg" / "0" / "000000.png"), cv2.IMREAD_UNCHANGED)
    truth = truth == next(row["label"] for row in _metrics(field)["classes"] if row["class"] == "can")
    assert (mask & truth).sum() > 0.6 * (mask | truth).sum()


@pytest.mark.slow
def test_resumed_it_is_the_same_field(gsjax, interrupted, pristine, scene, distilled, tmp_path):
    steps = ("--preset", "paper", "--distill.iterations", STEPS, *TABLE)
    told = ("distill", scene, "--out", tmp_path / "again", *images(pristine), *SMALL, *steps)
    with interrupted(105):  # between two rows of the curve
        code, said = gsjax(*told)
    assert code == 130, said
    assert (tmp_path / "again" / "field.npz").is_file()  # what was learned so far can be queried
    assert gsjax("query", tmp_path / "again", "can", "--threshold", 0)[0] == 0
    code, said = gsjax(*told)
    assert code == 2
    assert "--resume" in said
    code, said = gsjax(*told, "--resume")
    assert code == 0, said
    ours, theirs = np.load(tmp_path / "again" / "field.npz"), np.load(distilled / "field.npz")
    for name in theirs.files:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
    ours, theirs = (_metrics(run)["curve"] for run in (tmp_path / "again", distilled))
    for row in (*ours, *theirs):
        del row["seconds"]
    assert ours == theirs


@pytest.mark.thorough
def test_a_field_is_found_within_the_run_of_its_scene(gsjax, pristine, scene, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(scene, run / "scene.ply")
    settings = {
        "dataset": str(pristine),
        "frames": "0:1",
        "cameras": [],
        "eval_cameras": [2],
        "test_every": 8,
    }
    (run / "config.yml").write_text(
        "# gsjax run\n" + yaml.safe_dump(settings | {"fit": {"antialiased": False}})
    )
    code, said = gsjax("distill", run, *SMALL, "--distill.iterations", 20)
    assert code == 0, said
    assert (run / "field" / "field.npz").is_file()
    code, said = gsjax("query", run, "can", "--threshold", 0.0)
    assert code == 0, said
    assert _told(run)["scene"] == str(run / "scene.ply")
    moved = run.rename(tmp_path / "elsewhere")
    code, said = gsjax("query", moved, "can", "--threshold", 0.0)
    assert code == 0, said
    assert _told(moved)["scene"] == str(moved / "scene.ply")
    assert sorted(_told(moved)["pixels"]) == ["0", "1", "2"]
    code, said = gsjax("distill", moved, "--frames", "0:2", "--overwrite")
    assert code == 2
    assert "--frames" in said


@pytest.mark.slow
def test_colours_need_no_names_and_answer_to_pictures(gsjax, pristine, scene, tmp_path):
    out = tmp_path / "closed"
    told = ("--features", "closed", "--masks", "segment", *SMALL, *TABLE, "--distill.iterations", STEPS)
    code, said = gsjax("distill", scene, "--out", out, *images(pristine), *told)
    assert code == 0, said
    assert _metrics(out)["masks"] == "segment"
    code, said = gsjax("query", out, "red", "--threshold", 0.5)
    assert code == 0, said
    assert "nothing is drawn" not in said
    with np.load(out / "query" / "selection.npz") as found:
        meant, count = found["indices"], len(found["all_scores"])
    assert 0 < len(meant) < 0.2 * count
    red = np.zeros((20, 20, 3), np.uint8)
    red[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), red)
    code, said = gsjax("query", out, "--image", tmp_path / "red.png")
    assert code == 0, said
    with np.load(out / "query" / "selection.npz") as found:
        scores = found["all_scores"]
    assert np.median(scores[meant]) > np.quantile(scores, 0.9)


@pytest.mark.slow
def test_what_was_encoded_is_not_encoded_again(gsjax, pristine, scene, distilled, tmp_path, cache):
    told = ("distill", scene, *images(pristine), *SMALL, "--distill.iterations", 2)
    assert gsjax(*told, "--out", tmp_path / "a")[0] == 0
    again, kept = _metrics(tmp_path / "a")["encoded"], list(cache.rglob("*.npz"))
    assert again["anew"] == 0
    assert again["from_cache"] > 1
    for damaged in kept:
        damaged.write_bytes(b"cut off")
    assert gsjax(*told, "--out", tmp_path / "b")[0] == 0
    encoded = _metrics(tmp_path / "b")["encoded"]
    assert encoded["anew"] > 1
    assert encoded["anew"] + encoded["from_cache"] == again["from_cache"]
    assert sorted(cache.rglob("*.npz")) == sorted(kept)


@pytest.mark.thorough
def test_files_of_features_are_read_and_checked(gsjax, pristine, scene, tmp_path):
    folder = tmp_path / "features"
    random = np.random.default_rng(0)
    (folder / "0").mkdir(parents=True)
    (folder / "1").mkdir()
    (folder / "2").mkdir()
    for camera in "012":
        np.save(folder / camera / "0.npy", random.normal(size=(15, 20, 12)).astype(np.float32))
    told = ("distill", scene, *images(pristine), *SMALL, "--distill.iterations", 2, "--features", folder)
    assert gsjax(*told, "--out", tmp_path / "a")[0] == 0
    assert _metrics(tmp_path / "a")["dimension"] == 12
    code, said = gsjax("query", tmp_path / "a", "can")
    assert code == 2
    assert "--weights" in said
    assert "--point" in said

    def refused(array, *words):
        np.save(folder / "1" / "0.npy", array)
        code, said = gsjax(*told, "--out", tmp_path / "b")
        assert code == 2
        assert all(word in said for word in words), said

    refused(random.normal(size=(15, 50, 12)), "80x60", "50x15", "0.npy", "1/0")
    refused(random.normal(size=(15, 20, 7)), "12", "7", "0.npy")
    refused(np.full((15, 20, 12), np.nan), "NaN", "0.npy")
    refused(np.array([{}], object), "0.npy")
    (folder / "1" / "0.npy").unlink()
    code, said = gsjax(*told, "--out", tmp_path / "b")
    assert code == 2
    assert "1/0" in said
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--features", "nothing"), ("--features nothing", "classes")),
        (("--features", "clip"), ("--weights",)),
        (("--features", "classes", "--masks", "segment"), ("--features classes",)),
        (("--weights", "x", "--features", "closed"), ("--weights",)),
        (("--sam", "x", "--masks", "files"), ("--sam",)),
        (("--scale", 2), ("--scale",)),
        (("--frames", "9:"), ("--frames",)),
        (("--resume",), ("--resume",)),
    ],
)
def test_a_distillation_that_cannot_be_done(gsjax, pristine, scene, tmp_path, options, words):
    code, said = gsjax("distill", scene, "--out", tmp_path / "field", *images(pristine), *options)
    assert code == 2
    for word in words:
        assert word in said, said
    assert not (tmp_path / "field").exists()


@pytest.mark.thorough
def test_what_is_missing_is_said(gsjax, pristine, scene, tmp_path):
    code, said = gsjax("distill", scene, "--out", tmp_path / "x")
    assert code == 2
    assert "--images" in said
    code, said = gsjax("distill", scene, *images(pristine))
    assert code == 2
    assert "--out" in said
    code, said = gsjax("distill", tmp_path / "nothing", *images(pristine))
    assert code == 2
    assert "gsjax fit" in said
    code, said = gsjax("query", tmp_path / "nothing", "can")
    assert code == 2
    assert "expected the folder of a run, found nothing there" in said
