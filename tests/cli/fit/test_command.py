"""`gsjax fit` from a folder of photographs to a report; a run that was stopped resumes to the same bits."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console

import gsjax.engine.fit.ending
import gsjax.engine.fit.judge
import gsjax.engine.photographs
from gsjax.cli import main
from gsjax.data.video import describe_video
from gsjax.engine.fit.ablation import ablate_time
from gsjax.engine.fit.judge import Scores
from gsjax.engine.fit.schedule import Evaluation
from gsjax.engine.messages import Notes
from gsjax.engine.progress import Progress
from gsjax.engine.viewables import open_viewable
from gsjax.io.ply import read_ply
from gsjax.methods.fit import PRESETS

QUICK = ("--fit.steps", "24", "--fit.cap", "150", "--fit.start.count", "120", "--fit.sh-every", "12")
QUICK += ("--judge-every", "8", "--test-every", "4", "--fit.growth.begin", "4", "--fit.growth.every", "4")


@pytest.fixture
def gsjax_fit(photographs, tmp_path, capfd):
    """Runs `gsjax fit` in this process, into tmp_path/NAME; returns the exit code and its output."""

    def call(*options: str, name: str = "run", dataset=photographs) -> tuple[int, str]:
        code = main(["fit", str(dataset), "--out", str(tmp_path / name), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err

    return call


@pytest.mark.thorough
def test_a_run_from_photographs_to_a_report_and_one_that_was_stopped(gsjax_fit, tmp_path, monkeypatch):
    code, said = gsjax_fit(*QUICK)
    assert code == 0, said
    assert "of 10 listed photographs, 1 with no file (images/lost.png)" in said
    assert "held out" in said
    run = tmp_path / "run"
    found = json.loads((run / "metrics.json").read_text())
    assert found["complete"]
    assert found["photographs"] == {"fitted": 6, "held_out": 3, "looked_at": 3}
    assert found["steps"] == 24
    assert found["test"]["psnr"] > 8
    assert -1 < found["test"]["ssim"] < 1
    assert found["test"]["depth_mm"] is None
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [8, 16, 24]
    assert all(line["test_psnr"] > 5 for line in lines)
    gaussians, _ = read_ply(run / "scene.ply")
    assert gaussians.num == found["num_gaussians"] <= 150
    assert gaussians.sh_degree == found["sh_degree"] == 1
    pictures = sorted((run / "renders" / "held_out").iterdir())
    assert len(pictures) == 3
    assert cv2.imread(str(pictures[0])).shape[:2] == (7 * 36, 3 * 7 * 48)  # enlarged, for its captions
    parts = {row["part"]: row for row in found["parts"]}
    count = gaussians.num
    assert parts["all"] == {"part": "all", "gaussians": count, "sh_degree": 1, "psnr": found["test"]["psnr"]}
    assert parts["half of the Gaussians"]["gaussians"] == -(-count // 2)
    assert parts["a sixteenth"]["psnr"] < parts["half of the Gaussians"]["psnr"] <= parts["all"]["psnr"] + 0.5
    assert parts["colours of degree 0"]["sh_degree"] == 0
    assert parts["colours of degree 0"]["psnr"] != parts["all"]["psnr"]
    assert "a sixteenth" in (run / "report.html").read_text()
    assert "data:image/png" in (run / "report.html").read_text()
    assert "data:video/mp4" in (run / "report.html").read_text()
    assert describe_video(run / "video_orbit.mp4").frames == 90
    assert not (run / "resume").exists()
    assert set(found["seconds"]) == {"fit", "compile", "pruning", "scores", "parts", "video", "total"}
    config = yaml.safe_load((run / "config.yml").read_text())
    assert Path(config["dataset"]).is_absolute()

    add = Progress.add

    def stopped(self, tick):
        add(self, tick)
        if calls.append(1) or len(calls) == 14:  # after the degree has changed
            raise KeyboardInterrupt

    calls: list[int] = []
    with monkeypatch.context() as context:
        context.setattr(Progress, "add", stopped)
        code, said = gsjax_fit(*QUICK, name="stopped")
    assert code == 130
    assert "partial run" in said
    part = json.loads((tmp_path / "stopped" / "metrics.json").read_text())
    assert (part["complete"], part["steps"]) == (False, 14)
    assert (tmp_path / "stopped" / "scene.ply").exists()

    code, said = gsjax_fit(*QUICK, "--resume", "--fit.seed", "5", name="stopped")
    assert code == 2
    assert "was started with fit.seed 0, now it is 5. Use the same" in " ".join(said.split())
    code, said = gsjax_fit(*QUICK, name="stopped")
    assert code == 2
    assert "an unfinished run; continue it with --resume" in " ".join(said.split())
    code, said = gsjax_fit(*QUICK, "--resume", name="stopped")
    assert code == 0, said
    assert "Resumed after 14 steps" in json.dumps(
        json.loads((tmp_path / "stopped" / "metrics.json").read_text())
    )
    assert (tmp_path / "stopped" / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()

    assert gsjax_fit(*QUICK)[0] == 2  # a finished run is kept unless asked
    assert "nothing is left to resume" in " ".join(gsjax_fit(*QUICK, "--resume")[1].split())


@pytest.mark.slow
def test_what_minutes_decided_holds_when_a_run_is_resumed(gsjax_fit, tmp_path, monkeypatch):
    add = Progress.add

    def stopped(self, tick):
        add(self, tick)
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(Progress, "add", stopped)
        code, said = gsjax_fit("--minutes", "0.2")
    assert code == 130
    words = "up to 7,400 Gaussians with colours of degree 0, as there should be time for"
    assert words in " ".join(said.split())
    code, said = gsjax_fit("--resume")
    assert code == 2
    assert "was started with minutes 0.2, now it is None" in " ".join(said.split())
    code, said = gsjax_fit("--resume", "--minutes", "0.9")
    assert code == 0, said
    words = "p to 7,400 Gaussians, as when the run was started, with colours of degree"
    assert f"u{words}" in " ".join(said.split())
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["steps"] > 1
    assert found["num_gaussians"] <= 7_400
    assert any(note.startswith(f"U{words}") for note in found["notes"])


@pytest.mark.thorough
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_in_the_middle_of_a_step_leaves_what_can_be_resumed(photographs, gsjax_fit, tmp_path):
    """A step donates the buffers that it replaces, and most of the time a step is running."""
    run = tmp_path / "run"
    long = (*QUICK, "--fit.steps", "100000", "--judge-every", "50")
    command = [sys.executable, "-m", "gsjax.cli", "fit", str(photographs), "--out", str(run), *long]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    try:
        while not (run / "metrics.jsonl").exists():
            time.sleep(0.05)
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130, said
    assert "Traceback" not in said
    found = json.loads((run / "metrics.json").read_text())
    assert not found["complete"]
    assert found["steps"] >= 50
    newest = sorted((run / "resume").iterdir())[-1]
    assert newest.name == f"step-{found['steps']:08d}.npz"


@pytest.mark.slow
def test_a_preset_is_named_and_what_is_given_counts_more(photographs, tmp_path, capfd):
    run = tmp_path / "run"
    code = main(
        [
            "fit",
            str(photographs),
            "--preset",
            "classic",
            "--out",
            str(run),
            *QUICK,
            "--fit.split.begin",
            "4",
            "--tensorboard",
        ]
    )
    said = capfd.readouterr()
    assert code == 0, said
    config = yaml.safe_load((run / "config.yml").read_text())["fit"]
    assert (config["strategy"], config["cap"], config["split"]["begin"]) == ("split", 150, 4)
    assert list((run / "tensorboard").glob("events.*"))
    with pytest.raises(SystemExit):
        main(["fit", "--help"])
    said = capfd.readouterr().out
    assert all(name in said for name in PRESETS)
    with pytest.raises(SystemExit):
        main(["fit", str(photographs), "--out", str(run), "--preset", "clasic"])
    assert "classic" in capfd.readouterr().err


@pytest.mark.thorough
def test_minutes_of_which_compiling_took_most(gsjax_fit, tmp_path):
    code, said = gsjax_fit(*QUICK, "--fit.steps", "100000", "--minutes", "0.01", "--fit.sh-every", "100")
    assert code == 0, said
    said = " ".join(said.split())
    assert "compiling took" in said
    assert "s, of 1 given; programs are kept" in said
    assert "of 0.01 min, 1 steps: loss" in said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert "Colours are of degree 0: a degree is added every 100 steps (--fit.sh-every)." in found["notes"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("module", "what", "lacks"),
    [
        (gsjax.engine.fit.judge, "write_panel", "scoring"),
        (gsjax.engine.fit.ending, "ablate", "ablating"),
        (gsjax.engine.fit.ending, "write_orbit", "drawing a video"),
    ],
)
def test_ctrl_c_after_the_last_step_leaves_out_what_a_run_can_go_without(
    gsjax_fit, tmp_path, monkeypatch, module, what, lacks
):
    def stopped(*args, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, what, stopped)
    code, said = gsjax_fit(*QUICK, "--fit.steps", "8")
    assert code == 0, said
    assert f"warning: {lacks}" in said
    assert "was left out: Ctrl-C" in " ".join(said.split())
    assert (tmp_path / "run" / "report.html").exists()
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["complete"]


def test_what_a_part_of_the_time_bought_is_the_last_look_before_it():
    looks = [(1.0, 10.0), (2.0, 12.0), (4.5, 14.0), (6.0, 15.0), (9.0, None), (10.0, 16.0)]
    rows = [{"seconds": s, "test_psnr": p, "alive": int(100 * s), "step": 1} for s, p in looks]
    after = {row["part"]: (row["gaussians"], row["psnr"]) for row in ablate_time(rows)}
    assert list(after) == ["after half of the time", "after a quarter", "after an eighth"]
    assert list(after.values()) == [(450, 14.0), (200, 12.0), (100, 10.0)]
    assert ablate_time(rows[4:]) == []


@pytest.mark.thorough
def test_a_damaged_checkpoint_leaves_the_one_before(gsjax_fit, tmp_path, monkeypatch):
    add, calls, often = Progress.add, [], ("--save-every", "1e-9")

    def stopped(self, tick):
        add(self, tick)
        if calls.append(1) or len(calls) == 6:
            raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(Progress, "add", stopped)
        assert gsjax_fit(*QUICK, *often)[0] == 130
    *_, before, newest = sorted((tmp_path / "run" / "resume").iterdir())
    newest.write_bytes(newest.read_bytes()[:1000])
    code, said = gsjax_fit(*QUICK, *often, "--resume")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert f"Resumed after {int(before.stem.split('-')[1])} steps" in json.dumps(found["notes"])


@pytest.mark.thorough
def test_other_photographs_are_no_resuming(photographs, gsjax_fit, tmp_path, monkeypatch):
    def stopped(self, tick):
        raise KeyboardInterrupt

    fewer = Path(shutil.copytree(photographs, tmp_path / "photographs"))
    with monkeypatch.context() as context:
        context.setattr(Progress, "add", stopped)
        assert gsjax_fit(*QUICK, dataset=fewer)[0] == 130
    (fewer / "images" / "11.png").unlink()
    code, said = gsjax_fit(*QUICK, "--resume", dataset=fewer)
    assert code == 2
    assert "the photographs: expected the same as when the run in" in " ".join(said.split())
    assert (tmp_path / "run" / "report.html").is_file()


@pytest.mark.thorough
def test_it_stops_when_held_out_views_are_seen_as_well_as_asked(gsjax_fit, tmp_path):
    code, said = gsjax_fit(*QUICK, "--until-psnr", "1")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["complete"], found["steps"]) == (True, 8)


@pytest.mark.thorough
def test_it_stops_only_when_all_held_out_views_are(gsjax_fit, tmp_path, monkeypatch):
    """During the fit only some views are evaluated, which may be easy ones."""
    monkeypatch.setattr(
        Evaluation, "__call__", lambda self, now: {"test_psnr": 99.0} if now.step % 8 == 0 else None
    )
    code, said = gsjax_fit(*QUICK, "--until-psnr", "90")
    assert code == 0, said
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 24


@pytest.mark.thorough
def test_a_resumed_fit_is_judged_only_where_it_would_be(gsjax_fit, tmp_path, monkeypatch, interrupted):
    goal, mean = ("--until-psnr", "90"), Scores.mean
    with interrupted(12), monkeypatch.context() as context:
        context.setattr(
            Evaluation, "__call__", lambda self, now: {"test_psnr": 99.0} if now.step == 8 else None
        )
        assert gsjax_fit(*QUICK, *goal)[0] == 130
    monkeypatch.setattr(Scores, "mean", lambda self: mean(self) | {"psnr": 99.0})
    code, said = gsjax_fit(*QUICK, *goal, "--resume")
    assert code == 0, said
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["steps"] == 16


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--scale", "0"), "--scale: expected above 0"),
        (("--scale", "0.1"), "--scale 0.1: a photograph of 48x36 would be 5x4; expected 8 pixels"),
        (("--resume", "--overwrite"), "--resume and --overwrite: one continues a run"),
        (("--test-every", "1"), "--test-every: expected 0"),
        (("--minutes", "-1"), "--minutes: expected more than 0"),
        (("--until-psnr", "20", "--test-every", "0"), "--until-psnr: nothing is held out"),
        (("--fit.start.source", "cloud"), "start.source: the data has no points"),
        (("--fit.start.source", "depth"), "start.source: the data has no depth"),
    ],
)
def test_wishes_that_cannot_be_met(gsjax_fit, tmp_path, options, says):
    code, said = gsjax_fit(*options)
    assert code == 2
    assert says in said
    assert not (tmp_path / "run").exists()


@pytest.mark.thorough
def test_a_photograph_that_is_cut_off_is_named(photographs, gsjax_fit, tmp_path):
    copy = tmp_path / "copy"
    (copy / "images").mkdir(parents=True)
    for file in photographs.glob("**/*.*"):
        (copy / file.relative_to(photographs)).write_bytes(file.read_bytes())
    broken = copy / "images" / "11.png"
    broken.write_bytes(broken.read_bytes()[:-40])
    code, said = gsjax_fit(*QUICK, dataset=copy)
    assert code == 2
    assert "11.png" in said
    assert "cut off" in said


@pytest.mark.thorough
def test_photographs_that_do_not_fit_into_memory_are_refused_before_anything_is_cleared(
    gsjax_fit, tmp_path, monkeypatch
):
    old = tmp_path / "run"
    old.mkdir()
    (old / "config.yml").write_text("# gsjax run\n")
    (old / "scene.ply").write_text("of before")
    monkeypatch.setattr(gsjax.engine.photographs, "available_mb", lambda: 0.1)
    code, said = gsjax_fit(*QUICK, "--overwrite")
    assert code == 2
    assert "9 photographs need some 0.0 GB, and 0.0 GB are free; try --scale" in said
    monkeypatch.undo()
    code, said = gsjax_fit(*QUICK, "--overwrite", "--fit.start.source", "depth")
    assert (code, "the data has no depth" in said) == (2, True)
    assert (old / "scene.ply").read_text() == "of before"


@pytest.mark.slow
def test_photographs_far_from_0_are_fitted_scored_and_shown_like_others(photographs, tmp_path, capfd):
    shift, far = np.array([500_000.0, 5_000_000.0, 300.0]), tmp_path / "far"
    shutil.copytree(photographs, far)
    listed = json.loads((far / "transforms.json").read_text())
    for frame in listed["frames"][:-1]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] += shift
        frame["transform_matrix"] = pose.tolist()
    (far / "transforms.json").write_text(json.dumps(listed))
    run, options = tmp_path / "run", [*QUICK, "--fit.antialiased", "--fit.refine-poses"]
    assert main(["fit", str(far), "--out", str(run), *options]) == 0
    assert "coordinates reach 5e+06" in capfd.readouterr().err
    with pytest.warns(UserWarning, match="relative to the origin"):
        _, report = read_ply(run / "scene.ply")
    assert report.antialiased
    assert np.abs(np.median(report.places, axis=0) - shift).max() < 3
    cameras = np.load(run / "cameras.npz")
    centers = np.linalg.inv(cameras["viewmats"])[:, :3, 3]
    assert np.abs(centers - shift).max() < 5
    found = json.loads((run / "metrics.json").read_text())["test"]["psnr"]
    assert main(["eval", str(run)]) == 0
    again = json.loads((run / "eval" / "metrics.json").read_text())
    assert again["mean"]["held out"]["psnr"] == pytest.approx(found, abs=0.01)
    with Notes(Console(stderr=True)) as notes:
        scene, _ = open_viewable(run, notes)
    assert scene.shots is not None
    assert np.abs(scene.shots.viewmats[..., :3, 3]).max() < 10
    assert np.abs(np.median(scene.gaussians.means, axis=0)).max() < 5
