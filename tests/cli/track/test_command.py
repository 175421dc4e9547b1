"""`gsjax track` from end to end, on a tiny recording."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from rich.console import Console

import gsjax.engine.track.loop
from gsjax.data import Sequence
from gsjax.engine.messages import Notes
from gsjax.engine.recording import parse_frames
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.run import _note_lost
from gsjax.io.ply import read_ply
from gsjax.io.video import read_video_frames

CARTON, CAN, BALL = 2, 3, 4
QUICK = ("--track.start.iterations", "2")
CAMERAS = ("--cameras", "0", "1", "--mask-camera", "1", "--eval-cameras", "2")


@pytest.fixture
def opened(monkeypatch):
    """(frame, camera) of each mask that is opened, and None once tracking has ended."""
    log = []
    mask, follow = Sequence.mask, gsjax.engine.track.loop.follow

    def watched(sequence, t, c):
        log.append((sequence.frame_ids[t], sequence.camera_ids[c]))
        return mask(sequence, t, c)

    def followed(*arguments, **options):
        result = follow(*arguments, **options)
        log.append(None)
        return result

    monkeypatch.setattr(Sequence, "mask", watched)
    monkeypatch.setattr("gsjax.engine.track.run.follow", followed)
    return log


@pytest.mark.thorough
def test_a_run_from_end_to_end(pristine, tmp_path, gsjax_track, opened):
    code, said = gsjax_track(pristine, *CAMERAS, *QUICK)
    assert code == 0, said
    run = tmp_path / "run"
    assert "carton" in said
    assert "report.html" in said

    # Before tracking ended, no mask but the first of the mask camera was opened.
    assert opened[: opened.index(None)] == [(0, 1)]
    assert len(opened) > 2

    with np.load(run / "trajectory.npz") as file:
        saved = dict(file)
    frames, count, _ = saved["means"].shape
    assert frames == 4
    assert saved["labels"].shape == (count,)
    assert saved["label_ids"].tolist() == [0, 1, 2, 3, 4, 5]
    assert set(saved["labels"]) == set(range(6))
    assert saved["times"] == pytest.approx(np.arange(4) / 30)
    assert saved["update_s"][0] == 0
    assert (saved["update_s"][1:] > 0).all()
    assert np.isfinite(saved["means"]).all()
    still = saved["labels"] == 0
    assert (saved["means"][:, still] == saved["means"][0, still]).all()

    gaussians, report = read_ply(run / "scene.ply")
    assert report.labels.tolist() == saved["labels"].tolist()
    np.testing.assert_allclose(gaussians.means, saved["means"][0])

    found = json.loads((run / "metrics.json").read_text())
    assert found["complete"] is True
    assert list(found["objects"]) == ["robot", "carton", "can", "ball", "block"]
    # The can is all that moves in these frames; it is followed better than by leaving it where it was.
    can = found["objects"]["can"]
    assert can["moved_mm"] > 15
    assert can["centroid_error_mm"] < 0.5 * can["moved_mm"]
    assert found["objects"]["robot"]["centroid_error_mm"] is None
    assert found["objects"]["robot"]["pose"] is None
    # An object that stands still has almost no pose error; the can's is about that of its points.
    block = found["objects"]["block"]["pose"]
    assert block["add_s_mm"] - 1e-9 <= block["add_mm"] < 2
    assert min(block[name] for name in ("add_auc", "add_s_auc", "recall_5cm_5deg")) > 0.97
    pose = can["pose"]
    assert pose["model"] == "Gaussians of the first frame"
    assert (pose["mssd_recall"], pose["mspd_recall"]) == (None, None)
    assert pose["add_s_mm"] - 1e-9 <= pose["add_mm"] < 2 * can["point_error_mm"]
    assert 1 - pose["add_mm"] / 100 <= pose["add_auc"] <= 1
    assert "ADD-S" in said
    assert 0 < found["iou"]["robot"] <= 1
    assert 0 < found["iou_held_out"]["robot"] <= 1
    assert {name: scored["tracked"] for name, scored in found["cameras"].items()} == {
        "0": True,
        "1": True,
        "2": False,
    }
    for scored in found["cameras"].values():
        assert all(scored[name] is not None for name in ("psnr", "ssim", "depth_error_mm", "psnr_robot"))
    seconds = found["seconds"]
    parts = sum(seconds[name] for name in ("planning", "compile", "updates", "loading", "loop_rest"))
    assert parts == pytest.approx(seconds["loop_wall"])
    assert seconds["updates"] == pytest.approx(saved["update_s"].sum())
    assert seconds["loop_rest"] < 0.1 * seconds["loop_wall"]

    config = yaml.safe_load((run / "config.yml").read_text())
    assert config["cameras"] == [0, 1]
    assert config["track"]["start"]["iterations"] == 2
    for camera in (0, 1, 2):
        assert len(read_video_frames(run / f"video_{camera}.mp4")) == 4
        assert len(list((run / "renders" / str(camera)).glob("*.png"))) == 4
    for plot in ("centroid_error.svg", "update_time.svg", "psnr.svg", "paths.svg", "first_mask.png"):
        assert (run / "plots" / plot).stat().st_size > 1000
    page = (run / "report.html").read_text()
    assert page.count("data:video/mp4") == 3
    assert "the ground truth has no pose of it" in page


@pytest.mark.parametrize(("signals", "name"), [((), "Ctrl-C"), (("SIGTERM",), "SIGTERM")])
def test_ctrl_c_leaves_a_usable_run(pristine, tmp_path, gsjax_track, still, monkeypatch, signals, name):
    frame = Sequence.frame

    def interrupted(sequence, t):
        if t == 2 and sequence.num_cameras == 2:
            raise KeyboardInterrupt(*signals)  # a real signal would arrive at no exact step
        return frame(sequence, t)

    monkeypatch.setattr(Sequence, "frame", interrupted)
    code, said = gsjax_track(pristine, "--cameras", "0", "1", "--eval-cameras", "2")
    assert code == 130
    assert f"stopped: by {name} after 2 of 4 frames" in said
    run = tmp_path / "run"
    found = json.loads((run / "metrics.json").read_text())
    assert (found["complete"], found["stopped"]) == (False, name)
    assert (found["frames"]["tracked"], found["frames"]["scored"]) == (2, 2)
    assert np.load(run / "trajectory.npz")["means"].shape[0] == 2
    assert "partial run" in (run / "report.html").read_text()
    assert len(read_video_frames(run / "video_2.mp4")) == 2


@pytest.mark.thorough
def test_ctrl_c_while_scoring_keeps_what_was_scored(pristine, tmp_path, gsjax_track, still, monkeypatch):
    frame = Sequence.frame

    def interrupted(sequence, t):
        if t == 3 and sequence.num_cameras == 3:
            raise KeyboardInterrupt
        return frame(sequence, t)

    monkeypatch.setattr(Sequence, "frame", interrupted)
    code, said = gsjax_track(pristine, "--cameras", "0", "1", "--eval-cameras", "2")
    assert code == 130
    assert "scoring was stopped after 3 of 4 frames by Ctrl-C" in said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert (found["frames"]["tracked"], found["frames"]["scored"]) == (4, 3)
    assert (found["complete"], found["stopped"]) == (False, "Ctrl-C")


@pytest.mark.thorough
@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", pytest.param("SIGHUP", marks=pytest.mark.slow)])
def test_a_signal_stops_the_program(pristine, tmp_path, name):
    command = [sys.executable, "-m", "gsjax.cli", "track", str(pristine), "--out", str(tmp_path / "run")]
    process = subprocess.Popen([*command, *QUICK], stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "run" / "config.yml").exists():
        time.sleep(0.05)
        assert process.poll() is None
    time.sleep(0.5)  # it is compiling now, where JAX's own callbacks drop exceptions
    process.send_signal(signal.Signals[name])
    _, said = process.communicate(timeout=120)
    assert process.returncode == 130, said
    assert "Traceback" not in said
    assert "stopped" in said


@pytest.mark.thorough
def test_objects_found_without_masks(recording, tmp_path, gsjax_track, still):
    for mask in recording.glob("seg/*/*.png"):
        mask.unlink()
    for folder in (recording / "seg").iterdir():
        folder.rmdir()
    code, said = gsjax_track(recording, "--cameras", "1")
    assert code == 0, said
    assert "labels from the weight-free segmenter in camera 1" in said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["mask"] == {"source": "segment", "camera": 1}
    assert next(iter(found["objects"])) == "object 1"
    assert found["iou"] == {}
    notes = " ".join(found["notes"])
    assert "weight-free segmenter" in notes
    assert "the recording has no masks" in notes


@pytest.mark.thorough
def test_segmented_objects_are_scored_as_what_they_cover(pristine, tmp_path, gsjax_track, still):
    code, said = gsjax_track(pristine, "--cameras", "1", "--masks", "segment")
    assert code == 0, said
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert set(found["iou"]) >= {"robot", "carton"}
    assert found["objects"]["carton"]["point_error_mm"] is not None


@pytest.mark.thorough
def test_a_run_says_what_was_lost_and_whose_turn_is_not_known(
    pristine, tmp_path, gsjax_track, still, monkeypatch
):
    """The can is lost in updates 1 and 3, the last, and its rotation is unknown from update 2 on. The ball is
    lost in update 1; its rotation is known again in update 2, and unknown from update 3 on. The carton's
    rotation is unknown since it was lost, in update 2."""
    ids: list[int] = []

    def flagged(scene, first, frames, config, **how):
        ids[:] = scene.label_ids[1:]
        for t, now in enumerate(still(scene, first, frames, config), 1):
            lost, known = np.zeros(len(ids), bool), np.ones(len(ids), bool)
            lost[[ids.index(CAN), ids.index(BALL)]] = t == 1
            lost[ids.index(CAN)] |= t == 3
            lost[ids.index(CARTON)] = t == 2
            known[ids.index(CAN)] = t < 2
            known[ids.index(BALL)] = t == 2
            known[ids.index(CARTON)] = t < 2
            agrees = np.full(len(ids), 0.9)
            agrees[ids.index(BALL)] = 0.5 if t == 3 else 0.4
            yield replace(now, info=now.info | {"lost": lost, "turn_known": known, "agrees": agrees})

    monkeypatch.setattr(gsjax.engine.track.loop, "track", flagged)
    assert gsjax_track(pristine, "--cameras", "1")[0] == 0
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert [note for note in found["notes"] if note.startswith(("carton:", "can:", "ball:"))] == [
        "carton: lost in 1 frame, number 2.",
        "carton: its rotation is unknown from frame 2 on: it was lost then.",
        "can: lost in 2 frames, between 1 and the end.",
        "can: its rotation is unknown from frame 2 on: other rotations agree as well.",
        "ball: lost in 1 frame, number 1.",
        "ball: its rotation is unknown from frame 3 on: other rotations agree as well.",
        "ball: at the end, only 50% of its visible part, or of one of its rigid parts, agrees with the "
        "images; it shows other sides, or is not where it is drawn.",
    ]
    objects = found["objects"]
    lost = {name: o["frames_lost"] for name, o in objects.items() if o["frames_lost"]}
    assert lost == {"carton": 1, "can": 2, "ball": 1}
    unknown = {name: o["turn_unknown_from"] for name, o in objects.items() if o["turn_unknown_from"]}
    assert unknown == {"carton": 2, "can": 2, "ball": 3}
    assert found["objects"]["ball"]["agrees_least"] == pytest.approx(0.4)
    assert found["objects"]["can"]["agrees_last"] == pytest.approx(0.9)
    with np.load(tmp_path / "run" / "trajectory.npz") as stored:
        objects = stored["label_ids"][1:].tolist()
        np.testing.assert_allclose(stored["agrees"][:, objects.index(BALL)], [1, 0.4, 0.4, 0.5])
        frames, of = np.nonzero(stored["lost"])
        assert {(t, objects[k]) for t, k in zip(frames, of, strict=True)} == {
            (1, CAN),
            (3, CAN),
            (1, BALL),
            (2, CARTON),
        }
        frames, of = np.nonzero(~stored["turn_known"])
        unknown = {(t, objects[k]) for t, k in zip(frames, of, strict=True)}
        assert unknown == {(1, BALL), (3, BALL), (2, CAN), (3, CAN), (2, CARTON), (3, CARTON)}


def test_what_the_masks_count_as_background_has_that_name_when_it_is_lost():
    no, yes = np.array([False]), np.array([True])
    flags = {"lost": [no, yes], "visible": [yes, no], "turn_known": [yes, yes], "agrees": [np.ones(1)] * 2}
    tracking = Mock(spec=Tracking, num_frames=3, scene=SimpleNamespace(label_ids=(0, 4)), **flags)
    notes = Notes(Console(quiet=True))
    _note_lost({"objects": {}}, tracking, np.array([0, 0]), {}, (100, 105, 110), notes)
    name = "a segment that the recording's masks count as background"
    assert notes.all == [
        f"{name}: lost in 1 frame, between 110 and the end.",  # the number of the frame in the data
        f"{name}: no camera saw it, or one of its rigid parts, in 1 frame; it was not moved then.",
    ]


def test_finished_run_is_kept_unless_asked(pristine, tmp_path, gsjax_track, still):
    options = ("--cameras", "1", "--frames", "0:1")
    assert gsjax_track(pristine, *options)[0] == 0
    code, said = gsjax_track(pristine, *options)
    assert code == 2
    assert "finished run" in said
    assert gsjax_track(pristine, *options, "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("text", "frames"),
    [("0:60", range(60)), (":30", range(30)), ("0:9:2", range(0, 9, 2)), ("7:8", [7]), (":", range(100))],
)
def test_frames_are_slices(text, frames):
    assert list(range(100))[parse_frames(text)] == list(frames)


@pytest.mark.thorough
@pytest.mark.parametrize("text", ["", "7", "a:b", "1:2:3:4", "0:10:-1", "0:10:0"])
def test_other_words_are_no_frames(text):
    with pytest.raises(ValueError, match="--frames"):
        parse_frames(text)
