"""`gsjax eval` reproduces a fit's own scores and adds others; it says what it cannot score."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml

import gsjax.engine.fit.run
from gsjax.cli import main
from gsjax.engine.drive import drive
from gsjax.engine.records import read_record


@pytest.fixture(scope="module")
def fitted(photographs, tmp_path_factory):
    """A finished run on photographs of 48x36 pixels that ends with its initial Gaussians, so that no step is
    compiled; do not change it."""
    run = tmp_path_factory.mktemp("fitted") / "run"
    options = ("--fit.cap", "120", "--fit.start.count", "100", "--test-every", "4")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gsjax.engine.fit.run, "_fitted", lambda options, *given: drive(*given[:3]))
        assert main(["fit", str(photographs), "--out", str(run), *options]) == 0
    return run


@pytest.fixture
def run(fitted, tmp_path):
    """A copy of `fitted` to write into."""
    return shutil.copytree(fitted, tmp_path / "run")


@pytest.fixture
def gsjax_eval(run, capfd):
    """Runs `gsjax eval` on `run`; returns the exit code, its output and the scores that it wrote."""

    def call(*options: str, of=run):
        capfd.readouterr()
        code = main(["eval", str(of), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        found = of / "eval" / "metrics.json"
        return code, " ".join((out + err).split()), json.loads(found.read_text()) if code == 0 else None

    return call


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Weights for LPIPS with AlexNet whose first layer passes the red channel and whose others do nothing."""
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3)}
    shapes |= {10: (256, 256, 3, 3)}
    arrays = {}
    for head, (i, shape) in enumerate(shapes.items()):
        arrays[f"features.{i}.weight"] = np.zeros(shape, np.float32)
        arrays[f"features.{i}.bias"] = np.zeros(shape[0], np.float32)
        arrays[f"lin{head}.model.1.weight"] = np.zeros((1, shape[0], 1, 1), np.float32)
    arrays["features.0.weight"][0, 0, 5, 5] = 1
    arrays["features.0.bias"][:2] = 4, 1
    arrays["lin0.model.1.weight"][0, :2] = 1
    path = tmp_path_factory.mktemp("weights") / "lpips.npz"
    np.savez(path, **arrays)
    return path


@pytest.mark.thorough
def test_it_gives_the_numbers_of_the_fit(gsjax_eval, run):
    own = json.loads((run / "metrics.json").read_text())
    code, said, found = gsjax_eval()
    assert code == 0, said
    assert [row["view"] for row in found["views"]] == [row["view"] for row in own["views"]]
    assert len(found["views"]) == own["photographs"]["held_out"] == 3
    for row, known in zip(found["views"], own["views"], strict=True):
        assert row["psnr"] == pytest.approx(known["psnr"], abs=1e-9)
        assert row["ssim"] == pytest.approx(known["ssim"], abs=1e-9)
        assert (row["depth_mm"], row["ms_ssim"], row["lpips"]) == (None, None, None)
        assert row["split"] == "held out"
        ours, theirs = (cv2.imread(str(at)) for at in (run / "eval" / row["picture"], run / known["picture"]))
        np.testing.assert_array_equal(ours, theirs)
    assert found["mean"]["held out"]["psnr"] == pytest.approx(own["test"]["psnr"], abs=1e-9)
    assert f"{own['test']['psnr']:.2f}" in said
    assert "mean of 3 held out" in said
    assert "MS-SSIM: absent for 3 of 3 views, which have a side below 161 pixels" in said
    assert "data:image/png" in (run / "eval" / "report.html").read_text()
    assert read_record(run).evaluation == found


def test_views_that_were_fitted_too(gsjax_eval, run):
    code, said, found = gsjax_eval("--views", "all")
    assert code == 0, said
    assert [row["split"] for row in found["views"]] == ["held out"] * 3 + ["train"] * 6
    assert set(found["mean"]) == {"held out", "train"}
    assert found["mean"]["train"]["psnr"] == pytest.approx(
        np.mean([row["psnr"] for row in found["views"][3:]]), abs=1e-9
    )
    assert len(list((run / "eval" / "renders").iterdir())) == 9
    code, said, found = gsjax_eval("--views", "train")
    assert {row["split"] for row in found["views"]} == {"train"}
    assert len(list((run / "eval" / "renders").iterdir())) == 6  # those of the earlier evaluation are gone


def test_lpips_is_there_with_weights_and_said_to_be_absent_without(gsjax_eval, run, weights):
    _, said, found = gsjax_eval()
    assert "LPIPS: absent" in found["lpips"]["absent"]
    assert "--lpips-weights PATH" in said
    assert "--lpips-weights PATH" in (run / "eval" / "report.html").read_text()
    code, said, found = gsjax_eval("--lpips-weights", str(weights))
    assert code == 0, said
    assert found["lpips"]["network"] == "AlexNet"
    assert found["lpips"]["weights"] in said
    row = found["views"][0]
    # The red of every fourth pixel, and one channel that is 1 everywhere.
    panel = cv2.imread(str(run / "eval" / row["picture"]))[::7, ::7, 2] / 255
    red = [panel[3:35:4, 48 * i + 3 : 48 * i + 47 : 4] for i in (0, 1)]
    features = [np.stack([4 + (2 * r - 0.97) / 0.458, np.ones_like(r)]) for r in red]
    units = [f / np.linalg.norm(f, axis=0) for f in features]
    assert 0 < row["lpips"] == pytest.approx(((units[0] - units[1]) ** 2).sum(0).mean(), rel=0.3)


def test_pictures_of_enough_pixels_have_ms_ssim(tmp_path, capfd):
    from gsjax.cli.evaluate import scores
    from gsjax.engine.fit.judge import Compared
    from gsjax.geometry.cameras import Camera
    from gsjax.scene.frame import Frame

    rng = np.random.default_rng(0)
    truth = rng.uniform(0, 1, (170, 180, 3))
    photograph = np.round(255 * truth).astype(np.uint8)
    camera = Camera(np.eye(4)[None], np.eye(3)[None], 180, 170)
    view = Frame(photograph[None], np.full((1, 170, 180), 2.0, np.float32), camera)
    drawn = np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1)
    seen = Compared(view, drawn, truth, np.full((170, 180), 2.02, np.float32), np.ones((170, 180), bool))
    found = scores(seen, None)
    assert 0.5 < found["ssim"] < found["ms_ssim"] < 1
    assert found["depth_mm"] == pytest.approx(20, abs=1e-3)
    assert found["lpips"] is None
    assert found["psnr_matched"] is None
    dimmed = replace(seen, image=0.5 * truth + 0.2)
    assert scores(dimmed, None, exposed=True)["psnr_matched"] > scores(dimmed, None)["psnr"] + 20


@pytest.mark.thorough
def test_a_comparison_takes_what_it_found(gsjax_eval, run, fitted, weights, tmp_path, capfd):
    assert gsjax_eval("--views", "all", "--lpips-weights", str(weights))[0] == 0
    other = shutil.copytree(fitted, tmp_path / "other")
    out = tmp_path / "comparison"
    assert main(["compare", str(run), str(other), "--out", str(out)]) == 0
    found = json.loads((out / "comparison.json").read_text())
    mine, others = found["runs"]
    known = json.loads((run / "eval" / "metrics.json").read_text())["mean"]["held out"]
    for key in ("psnr", "ssim"):
        assert mine[key] == others[key] == pytest.approx(known[key], abs=1e-9)
    assert mine["lpips"] == pytest.approx(known["lpips"])
    assert others["lpips"] is None
    assert found["groups"][0]["best"] == {}
    assert found["options"] == {}
    assert len(list((out / "pictures").iterdir())) == 3


def test_photographs_that_moved(gsjax_eval, photographs, run, tmp_path):
    moved = shutil.copytree(photographs, tmp_path / "elsewhere")
    config = yaml.safe_load((run / "config.yml").read_text())
    text = (run / "config.yml").read_text().replace(config["dataset"], str(tmp_path / "gone"))
    (run / "config.yml").write_text(text)
    code, said, _ = gsjax_eval()
    assert code == 2
    assert "gone" in said
    assert "pass their new folder as --images" in said
    code, said, found = gsjax_eval("--images", str(moved))
    assert code == 0, said
    assert found["mean"]["held out"]["psnr"] == pytest.approx(
        json.loads((run / "metrics.json").read_text())["test"]["psnr"], abs=1e-9
    )
    code, said, _ = gsjax_eval("--images", "simulated:tabletop?width=32&height=32&frames=3")
    assert code == 2
    assert "expected the photographs of the fit, which held out images/00.png" in said


def test_what_cannot_be_scored_is_said(gsjax_eval, run, tmp_path, weights):
    other = tmp_path / "lpips.pth"
    other.write_bytes(b"\x80\x02.")
    code, said, _ = gsjax_eval("--lpips-weights", str(other))
    assert code == 2
    assert "weights_only=True" in said
    assert not (run / "eval").exists()  # nothing was begun

    assert "found nothing there" in gsjax_eval(of=tmp_path / "none")[1]
    assert "found other files" in gsjax_eval(of=tmp_path)[1]

    config = run / "config.yml"
    whole = config.read_text()
    settings = yaml.safe_load(whole)
    config.write_text("# gsjax run\n" + yaml.safe_dump(settings | {"test_every": 0}))
    assert "the fit held out no photograph; score those it saw by --views train" in gsjax_eval()[1]
    (run / "metrics.json").unlink()  # other commands write a different one
    config.write_text("# gsjax run\n" + yaml.safe_dump({"track": {}, "eval_cameras": []}))
    assert "expected a run of `gsjax fit`, found one of `gsjax track`" in gsjax_eval()[1]
    config.write_text("# gsjax run\nsource: camera:0\n")
    assert "settings of another command or version (source)" in gsjax_eval()[1]
    config.write_text("# gsjax run\n}{")
    assert "config.yml: expected what a run wrote, found other text" in gsjax_eval()[1]
    config.write_text(whole)
    (run / "scene.ply").unlink()
    code, said, _ = gsjax_eval()
    assert code == 2
    assert "expected a scene.ply to score, found none" in said
