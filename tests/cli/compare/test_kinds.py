"""`gsjax compare` knows runs of every method: what it shows stands in their metrics.json."""

import json
from pathlib import Path

import pytest
import yaml

from gsjax.cli import main
from gsjax.engine.compare.data import SCORES

MACHINE = {
    "processor": "x",
    "cores": 2,
    "avx512": False,
    "device": "cpu",
    "devices": 1,
    "jax": "0",
    "python": "3",
}
CONFIG = {
    "parts": {"parts": {"seed": 0}, "anchor": 0, "fit": {"steps": 9}, "eval_cameras": [3]},
    "distill": {"distill": {"seed": 0}, "features": "auto"},
    "deform": {"deform": {"seed": 0}, "tools": "draw", "features": "auto", "eval_cameras": []},
}


def metrics_of(kind: str, psnr: float) -> dict:
    shared = {
        "kind": kind,
        "dataset": "made up",
        "complete": True,
        "report": True,
        "machine": MACHINE,
        "notes": [],
    }
    if kind == "parts":
        part = {"part": 1, "name": "part 1", "iou": 0.5, "point_error_mm": 20.0}
        return shared | {
            "image": {"width": 96, "height": 72},
            "frames": {"first_id": 0, "last_id": 9, "asked": 10, "followed": 10},
            "tracked_cameras": [0, 1],
            "held_out_cameras": [3],
            "num_gaussians": 900,
            "num_parts": 2,
            "ari": 0.7,
            "parts": [part, part | {"iou": None, "point_error_mm": None}, part | {"iou": 0.7}],
            "tracked": {"psnr": psnr},
            "held_out": {"psnr": psnr - 1, "ssim": 0.8},
            "update_s": {"median": 3.0},
        }
    learned = {
        "size": [96, 72],
        "judged_by": "held out",
        "steps": 40,
        "seconds": {"steps": 90.0, "compile": 30.0},
    }
    if kind == "distill":
        return shared | learned | {"views": {"taught": 9}, "test": {"cosine": psnr / 100}, "trained": 12}
    test = {"psnr_masked": psnr, "ssim": 0.8, "depth_mm": 2.0}
    frames = {"learned": 8, "held_out": 2}
    return shared | learned | {"frames": frames, "test": test, "tracks": None, "num_gaussians": 5}


def write_run(folder: Path, kind: str, psnr: float, **settings) -> Path:
    folder.mkdir()
    (folder / "config.yml").write_text("# gsjax run\n" + yaml.safe_dump(CONFIG[kind] | settings))
    (folder / "metrics.json").write_text(json.dumps(metrics_of(kind, psnr)))
    return folder


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


def test_kinds_are_not_mixed_and_time_means_minutes_of_steps_and_compiling(tmp_path, capfd):
    parts, deform = write_run(tmp_path / "a", "parts", 20.0), write_run(tmp_path / "b", "deform", 20.0)
    assert main(["compare", str(parts), str(deform)]) == 2
    assert "expected runs of one command" in " ".join(capfd.readouterr().err.split())
    other = write_run(tmp_path / "c", "deform", 21.0)
    assert main(["compare", str(deform), str(other), "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "comparison.json").read_text())["runs"][0]["minutes"] == 2.0
