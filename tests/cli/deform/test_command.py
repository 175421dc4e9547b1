"""`gsjax deform` from the command line: what it writes, resuming, and options it refuses."""

import json

import cv2
import numpy as np
import pytest

from gsjax.cli import main
from gsjax.engine.deform.file import read_deformation
from gsjax.engine.deform.scores import OVER_TIME
from gsjax.io.ply import read_ply

SCENE = "simulated:tissue?width=64&height=52&frames=10"
SMALL = ("--deform.warmup", 6, "--deform.iterations", 24, "--deform.start-pixels", 1.5, "--deform.nodes", 48)
SMALL += ("--deform.deformation.resolution", 8, "--deform.deformation.levels", 1, "--deform.channels", 4)
SMALL += ("--deform.graph.nodes", 16, "--deform.graph.neighbors", 2, "--deform.graph.window", 1)


def metrics(run):
    return json.loads((run / "metrics.json").read_text())


@pytest.fixture(scope="module")
def deformed(tmp_path_factory):
    run = tmp_path_factory.mktemp("deformed") / "run"
    told = ("deform", SCENE, "--out", run, "--tools", "draw", *SMALL)
    assert main([str(one) for one in told]) == 0
    return run


@pytest.mark.thorough
def test_what_a_run_writes(deformed):
    found = metrics(deformed)
    assert (found["kind"], found["complete"], found["steps"], found["skipped"]) == ("deform", True, 30, 0)
    assert found["frames"] == {"learned": 8, "held_out": 2}  # frames 1 and 9
    assert found["names"] == ["tissue", "tool"]
    assert (found["masks"], found["tools"]) == ("files", "draw")
    assert found["test"]["psnr_masked"] > 15
    assert found["test"]["fps"] > 0
    assert found["tracks"]["points"] > 50
    assert found["memory_mb"]["process"] > 100
    for frame in (1, 9):
        picture = cv2.imread(str(deformed / "test" / f"{frame:06d}.png"))
        assert picture.shape == (52, 64, 3)
        assert picture.std() > 5
    assert "rendering rate" in (deformed / "report.html").read_text()
    assert read_ply(deformed / "scene.ply")[0].num == found["num_gaussians"]
    told = read_deformation(deformed / "deformation.npz")
    assert told.names == ("tissue", "tool")
    assert not (deformed / "resume").exists()
    assert [row["step"] for row in found["curve"]] == [10, 20, 30]
    assert found["curve"][-1]["structure"] is not None  # by the end the graph has a loss


@pytest.mark.thorough
def test_scores_over_time_and_of_classes(deformed):
    found = metrics(deformed)
    test = found["test"]
    assert test["ms_ssim"] is None  # the picture is too small
    assert 0.5 < test["t_ssim"] <= 1
    assert 0.5 < test["flow_warp_share"] <= 1
    for name in OVER_TIME:
        gaps = [abs(row[name] - row[f"{name}_true"]) for row in found["scores"]]
        assert test[f"{name}_gap"] == pytest.approx(np.mean(gaps))
    assert [one["class"] for one in found["classes"]] == found["names"]
    for one in found["classes"]:
        assert one["dice"] == pytest.approx(2 * one["iou"] / (1 + one["iou"]))
    for name in ("iou", "dice", "f1"):
        assert test[name] == pytest.approx(np.mean([one[name] for one in found["classes"]]))
    assert 0.5 < test["accuracy"] <= 1
    assert test["f_psnr"] > 6  # 6.0 dB is that of a random code of four channels
    report = (deformed / "report.html").read_text()
    assert "t-SSIM" in report
    assert "Dice" in report


@pytest.mark.slow
def test_resumed_it_is_the_same_scene(gsjax, deformed, interrupted, tmp_path):
    told = ("deform", SCENE, "--out", tmp_path / "run", "--tools", "draw", *SMALL)
    with interrupted(25):  # after the graph was made
        code, said = gsjax(*told)
    assert code == 130, said
    assert metrics(tmp_path / "run")["complete"] is False
    code, said = gsjax(*told, "--resume")
    assert code == 0, said
    ours, theirs = np.load(tmp_path / "run" / "deformation.npz"), np.load(deformed / "deformation.npz")
    for name in theirs.files:
        if not name.startswith("__"):
            np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)


@pytest.mark.slow
def test_a_recipe_by_its_name(gsjax, tmp_path):
    """GaussianClin's rotations are differences of quaternions; with tools left out there is one class."""
    run = tmp_path / "run"
    code, said = gsjax("deform", SCENE, "--preset", "clin", "--out", run, "--scale", 0.5, *SMALL)
    assert code == 0, said
    assert read_deformation(run / "deformation.npz").scene.field.config.rotation == "add"
    assert metrics(run)["names"] == []
    assert {metrics(run)["test"][name] for name in ("iou", "dice", "f1", "accuracy", "f_psnr")} == {None}
    assert metrics(run)["size"] == [32, 26]


@pytest.mark.parametrize(
    ("told", "words"),
    [
        (("--cameras", 7), "--cameras: tissue_seed0 has no camera 7; it has [0, 1]"),
        (("--cameras", 0, 1), "--cameras: expected one training camera, found [0, 1]"),
        (("--eval-cameras", 7), "--eval-cameras: tissue_seed0 has no camera 7; it has [0, 1]"),
        (("--eval-cameras", 0, 1), "--eval-cameras: expected one held-out camera, found [0, 1]"),
        (
            ("--cameras", 1, "--eval-cameras", 1),
            "--eval-cameras: expected a camera other than the training camera",
        ),
        (("--test-every", 1), "--test-every: expected 0 (none), or 2 or more, found 1"),
        (("--features", "classes"), "expected two classes or more to learn, found 1"),
        (("--tools", "draw", "--deform.channels", 1), "--deform.channels 1: expected at least 2"),
        (("--scale", 2), "--scale: expected above 0 and at most 1"),
    ],
)
def test_what_is_asked_is_checked(gsjax, tmp_path, told, words):
    code, said = gsjax("deform", SCENE, "--out", tmp_path / "run", *told)
    assert code == 2
    assert words in said
    assert not (tmp_path / "run").exists()
