"""`gsjax compare` on runs of the other methods, whose scores it reads from metrics.json."""

import json

import pytest

from gsjax.cli import main
from gsjax.engine.compare.data import SCORES
from tests.cli.compare.made_up_runs import write_run

_OF_PIXELS = "PSNR masked, SSIM, depth error, f-PSNR, IoU of classes"
_COMPARED = {"deform": {*_OF_PIXELS.split(", ")}, "distill": {"cosine to the teacher"}}


@pytest.mark.parametrize(
    ("kind", "key", "better"),
    [("parts", "psnr_held_out", "more"), ("distill", "cosine", "more"), ("deform", "psnr_masked", "more")],
)
def test_two_runs_of_a_kind_stand_side_by_side(tmp_path, kind, key, better, capfd):
    runs = [write_run(tmp_path / name, kind, psnr, scale=psnr) for name, psnr in (("a", 20.0), ("b", 25.0))]
    assert main(["compare", *map(str, runs), "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert found["kind"] == kind
    assert found["groups"][0]["best"][key] == ["b"]
    assert found["better"][key] == better
    assert list(found["options"]) == ["scale"]
    assert set(found["runs"][0]) >= {score.key for score in SCORES[kind]}
    assert "scale" in capfd.readouterr().out


def test_scores_of_parts_are_means_over_those_whose_truth_is_known(tmp_path):
    runs = [write_run(tmp_path / name, "parts", psnr) for name, psnr in (("a", 20.0), ("b", 25.0))]
    assert main(["compare", *map(str, runs), "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"][0]
    assert found["iou"] == pytest.approx(0.6)
    assert found["point_error_mm"] == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("kind", "settings", "used", "option", "scores"),
    [
        ("deform", {"deform": {"channels": 32}}, {}, "deform.channels", "f-PSNR"),
        ("deform", {"features": "clip"}, {}, "features", "f-PSNR, IoU of classes"),
        ("deform", {"tools": "leave-out"}, {}, "tools", _OF_PIXELS),
        ("deform", {"tools": "leave-out"}, {"tools": "draw"}, None, ""),  # the recording has no masks
        ("deform", {"depth": "stereo"}, {"depth": {"source": "stereo"}}, "depth", "depth error"),
        ("deform", {"depth": "data"}, {}, None, ""),
        ("deform", {"level": "large"}, {}, None, ""),  # the other run is of a version without the option
        ("distill", {"features": "clip"}, {}, "features", "cosine to the teacher"),
        ("distill", {"features": "classes", "masks": "files"}, {}, None, ""),
    ],
)
def test_scores_of_other_pixels_depth_channels_or_teachers_are_not_compared(
    tmp_path, kind, settings, used, option, scores
):
    runs = [write_run(tmp_path / "a", kind, 20.0), write_run(tmp_path / "b", kind, 25.0, **settings)]
    for run, shift in zip(runs, (0.0, 0.1), strict=True):
        found = json.loads((run / "metrics.json").read_text())
        test = found["test"] | ({"f_psnr": 26.0, "iou": 0.5} if kind == "deform" else {})
        found |= {"features": "classes", "masks": "files", "depth": {"source": "data"}}
        found |= {"test": {key: value + shift for key, value in test.items()}} | (used if shift else {})
        (run / "metrics.json").write_text(json.dumps(found))
    assert main(["compare", *map(str, runs), "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "comparison.json").read_text())
    compared = {score.head for score in SCORES[kind] if score.key in found["groups"][0]["best"]}
    apart = [note for note in found["notes"] if "they are not compared by" in note]
    assert apart == ([f"a, b differ in --{option}, so they are not compared by {scores}."] if option else [])
    assert compared == _COMPARED[kind] - {*scores.split(", ")}


def test_kinds_are_not_mixed_and_time_means_minutes_of_steps_and_compiling(tmp_path, capfd):
    parts, deform = write_run(tmp_path / "a", "parts", 20.0), write_run(tmp_path / "b", "deform", 20.0)
    assert main(["compare", str(parts), str(deform)]) == 2
    assert "expected runs of one command" in " ".join(capfd.readouterr().err.split())
    other = write_run(tmp_path / "c", "deform", 21.0)
    assert main(["compare", str(deform), str(other), "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"][0]["minutes"] == 2.0
