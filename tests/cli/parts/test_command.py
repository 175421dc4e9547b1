"""`gsjax parts` from a built-in scene to a report; a run that was stopped resumes to the same bits."""

import json
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

import gsjax.engine.parts.run
from gsjax.cli import main
from gsjax.data.video import describe_video
from gsjax.engine.drive import Drive
from gsjax.engine.photographs import choose_photographs, split
from gsjax.engine.progress import Progress, save_run
from gsjax.engine.recording import chosen_recording
from gsjax.io.ply import read_ply
from gsjax.methods.parts import order_of_frames
from gsjax.optim.method import Run
from gsjax.viz.colors import label_color

SCENE = "simulated:hard_parts?case=small&amount=0.05&width=96&height=72&cameras=4"
QUICK = (
    *("--frames", "0:16:5", "--eval-cameras", "3", "--masks", "files"),
    *("--fit.steps", "120", "--fit.cap", "1500", "--fit.start.count", "1500", "--fit.coarse-until", "0"),
    *("--parts.stream.iterations", "30", "--parts.stream.coarse", "0", "--parts.refine.iterations", "5"),
    *("--parts.discover.lift-iterations", "3", "--parts.discover.most-parts", "6"),
)


@pytest.fixture
def gsjax_parts(tmp_path, capfd):
    """Runs `gsjax parts` in this process, into tmp_path/NAME; returns the exit code and its output."""

    def call(*options: str, name: str = "run", dataset=SCENE) -> tuple[int, str]:
        code = main(["parts", str(dataset), "--out", str(tmp_path / name), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err

    return call


@pytest.mark.thorough
def test_a_run_from_a_scene_to_a_report(gsjax_parts, tmp_path):
    code, said = gsjax_parts(*QUICK, "--anchor", "0")
    assert code == 0, said
    run = tmp_path / "run"
    found = json.loads((run / "metrics.json").read_text())
    assert found["complete"]
    assert found["frames"]["followed"] == 4
    assert found["held_out"]["psnr"] > 8
    rows = [row for row in found["curve"] if "frame" in row]
    assert [row["frame"] for row in rows] == [1, 2, 3]
    assert all(row["update_s"] > 0 and len(row["losses"]) == 2 for row in rows)
    assert found["seconds"]["updates"] == pytest.approx(sum(row["update_s"] for row in rows))
    box = next(row for row in found["parts"] if row.get("true_name") == "box")
    assert box["moved_mm"] > 200
    assert box["median_point_error_mm"] < 50
    assert box["iou"] > 0.6
    assert found["ari"] > 0.3
    arrays = dict(np.load(run / "parts.npz"))
    count, parts = arrays["weights"].shape
    shapes = {name: array.shape for name, array in arrays.items()}
    assert shapes == {
        "anchor": (),
        "means0": (count, 3),
        "weights": (count, parts),
        "labels": (count,),
        "centres": (parts, 3),
        "R": (4, parts, 3, 3),
        "t": (4, parts, 3),
        "times": (4,),
    }
    np.testing.assert_allclose(arrays["weights"].sum(-1), 1, rtol=1e-5)
    np.testing.assert_array_equal(arrays["labels"], arrays["weights"].argmax(-1))
    np.testing.assert_allclose(
        arrays["R"][int(arrays["anchor"])], np.tile(np.eye(3), (parts, 1, 1)), atol=1e-6
    )
    np.testing.assert_array_equal(arrays["t"][:, 0], 0)
    assert np.linalg.norm(arrays["t"][-1, box["part"]]) > 0.1
    np.testing.assert_allclose(arrays["times"], np.array([0, 5, 10, 15]) / 15)
    assert parts == found["num_parts"] + 1
    gaussians, _ = read_ply(run / "scene.ply")
    np.testing.assert_allclose(gaussians.means, arrays["means0"], atol=1e-6)
    for camera in range(4):
        assert describe_video(run / f"video_{camera}.mp4").frames == 4
    assert (run / "canonical" / "report.html").is_file()
    assert not (run / "resume").exists()
    page = (run / "report.html").read_text()
    assert "Parts found from motion" in page
    assert "Camera 3, held out" in page
    most = max(found["parts"], key=lambda row: row["moved_mm"])["part"]
    assert f'gsjax edit {run} --op "speed:parts={most},factor=2"' in unescape(page)
    first = f'background: rgb{label_color(found["parts"][0]["part"])}"></i>part '
    assert first in page
    assert "following parts; compiling" in said
    assert "4 of 4 frames, " in said

    code, said = gsjax_parts(*QUICK)
    assert code == 2
    assert "holds a finished run" in said


def test_all_cameras_that_are_not_held_out_take_part_in_the_canonical_scene(tmp_path, monkeypatch):
    """Regression test: every eighth was left out, that is camera 0."""
    fits = []
    monkeypatch.setattr(gsjax.engine.parts.run, "run_fit", lambda options: fits.append(options) or 130)
    told = ("parts", "simulated:articulated?width=64&height=48", "--out", str(tmp_path / "run"))
    main([*told, "--frames", "0:16:5", "--cameras", "0", "1"])
    (options,) = fits
    chosen = choose_photographs(options.dataset, frames=options.frames, cameras=options.cameras)
    assert len(split(chosen, options.test_every)[0]) == 2


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on_to_the_same_bits(gsjax_parts, tmp_path, monkeypatch):
    code, said = gsjax_parts(*QUICK)
    assert code == 0, said
    run = tmp_path / "run"
    arrays = dict(np.load(run / "parts.npz"))
    given = ("--scene", str(run / "canonical"), "--anchor", str(int(arrays["anchor"])))

    def stopped_after(step, name):
        """Runs until Ctrl-C after `step` steps; returns metrics.json and the output."""
        advance = Drive.__next__

        def interrupted(ticks):
            if ticks.run.step == step:
                raise KeyboardInterrupt
            return advance(ticks)

        monkeypatch.setattr(Drive, "__next__", interrupted)
        code, said = gsjax_parts(*QUICK, *given, name=name)
        monkeypatch.undo()
        assert code == 130
        found = json.loads((tmp_path / name / "metrics.json").read_text())
        assert not found["complete"]
        return found, said

    def resumed(name):
        code, said = gsjax_parts(*QUICK, *given, "--resume", name=name)
        assert code == 0, said
        again = dict(np.load(tmp_path / name / "parts.npz"))
        for key, array in arrays.items():
            np.testing.assert_array_equal(again[key], array, err_msg=key)
        found = json.loads((tmp_path / name / "metrics.json").read_text())
        assert [row["frame"] for row in found["curve"] if "frame" in row] == order_of_frames(
            4, int(arrays["anchor"])
        )
        assert found["steps"] == 3 * 30 + 5

    partial, said = stopped_after(30 + 7, "stopped")  # within the second frame
    assert partial["frames"]["followed"] == 2
    assert "partial run" in said
    assert "not complete" in " ".join(partial["notes"])
    resumed("stopped")

    _, said = stopped_after(3 * 30 + 1, "late")
    assert "refined for 1 of 5 steps, then stopped by Ctrl-C" in said
    resumed("late")


@pytest.mark.thorough
def test_a_run_that_cannot_be_resumed_stays_as_it_was(gsjax_parts, tmp_path, monkeypatch):
    monkeypatch.setattr(gsjax.engine.parts.run, "run_fit", lambda options: 130)
    run, given = tmp_path / "run", (*QUICK, "--anchor", "0")
    assert gsjax_parts(*given)[0] == 130
    (run / "report.html").touch()
    save_run(run / "resume", Run(None, None), Progress({"the recording": "another"}))
    before = {file: file.read_bytes() for file in run.rglob("*.*") if file.is_file()}
    code, said = gsjax_parts(*given, "--resume")
    assert code == 2, said
    assert "the recording: expected the same as when the run in" in " ".join(said.split())
    assert {file: file.read_bytes() for file in run.rglob("*.*") if file.is_file()} == before


@pytest.mark.thorough
def test_what_cannot_be_done_is_said(gsjax_parts, tmp_path):
    code, said = gsjax_parts("--cameras", "1", "--frames", "0:3")
    assert code == 2
    assert "--cameras: expected at least 2 that see the scene at once, found [1]" in said
    code, said = gsjax_parts("--frames", "3:4")
    assert code == 2
    assert "--frames: expected 2 or more, between which something moves, found 3:4" in said
    code, said = gsjax_parts("--frames", "0:3", "--scene", str(tmp_path))
    assert code == 2
    assert "--scene: expected --anchor too" in said
    code, said = gsjax_parts("--frames", "0:24:8", "--scene", str(tmp_path), "--anchor", "0")
    assert code == 2
    assert "expected the folder of a run of `gsjax fit`" in said
    code, said = gsjax_parts("--scale", "0.05")
    assert code == 2
    assert "--scale 0.05: pictures of 96x72 would be 5x4; expected 8 pixels or more a side" in said
    code, said = gsjax_parts("--frames", "0:3", "--anchor", "7")
    assert code == 2
    assert "--anchor: expected one of 3 frames, 0 to 2, found 7" in said
    code, said = gsjax_parts("--frames", "0:3", "--masks", "files", "--sam", str(tmp_path))
    assert code == 2
    assert "--sam: expected --masks segment" in said
    code, said = gsjax_parts("--frames", "0:3", "--sam", str(tmp_path / "nowhere"))
    assert code == 2
    assert f"{tmp_path / 'nowhere'}: expected a folder of SAM's weights" in said
    assert not (tmp_path / "run" / "parts.npz").exists()


def test_masks_that_are_not_there(gsjax_parts, monkeypatch):
    def maskless(options):
        recording = chosen_recording(options)
        return replace(recording, tracked=replace(recording.tracked, load_mask=None))

    monkeypatch.setattr(gsjax.engine.parts.run, "chosen_recording", maskless)
    code, said = gsjax_parts("--frames", "0:24:8", "--masks", "files")
    assert code == 2
    assert "--masks files: expected a mask of frame" in said
    assert "for each camera, found none for 0, 1, 2, 3" in said


@pytest.mark.slow
def test_a_segmenter_says_which_parts_there_are(gsjax_parts, tmp_path):
    code, said = gsjax_parts(*QUICK, "--masks", "segment", "--parts.unify.least-gain", "0")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["pieces"] >= 2
    assert found["num_parts"] >= 1


def test_a_scene_is_not_read_from_what_is_replaced(gsjax_parts, tmp_path):
    inside = ("--scene", str(tmp_path / "run" / "canonical"), "--anchor", "0")
    code, said = gsjax_parts(*QUICK, *inside, "--overwrite")
    assert code == 2
    assert "expected one outside --out, which --overwrite replaces" in said


@pytest.mark.thorough
def test_a_scene_in_which_nothing_moves(gsjax_parts, tmp_path):
    still = "simulated:articulated?width=48&height=36&cameras=2&still=true"
    code, said = gsjax_parts("--frames", "0:3", "--fit.steps", "4", "--fit.cap", "300", dataset=still)
    assert code == 2
    assert "expected something that moves, found 0.000% of the pixels" in said
