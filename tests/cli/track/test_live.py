"""`gsjax live` around a tracker whose objects stand still: what is counted, written and reported."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import gsjax.data.stream
from gsjax.cli import main
from gsjax.data import open_sequence, write_panoptic
from gsjax.data.opencv_cameras import RgbdCamera
from gsjax.data.stream import Snapshot, StreamStalled
from gsjax.engine.track import live as engine
from gsjax.io.pictures import write_png
from gsjax.methods.track import start_scene
from gsjax.scene.origin import about
from tests.cli.conftest import still_tick


def standing_still(scene, first, frames, config, *, budget_ms, like):
    """`track` for objects that never move."""
    groups = scene.num_objects
    info = {"motion": SimpleNamespace(twists=jnp.zeros((groups, 6))), "centers": jnp.ones((groups, 3))}
    info["lost"] = jnp.arange(groups) == groups - 1
    info["turn_known"] = jnp.arange(groups) > 0
    info["looked_for"] = jnp.arange(groups) < 2
    for count, _ in enumerate(frames):
        yield still_tick(scene, count + 1, info | {"skipped": count == 2}, 0.001)


def unfitted(frame, mask, camera, config, before_fit):
    """`start_scene` without the optimisation, and without a rehearsal before it."""
    config = replace(config, start=replace(config.start, iterations=0))
    return start_scene(frame, mask, camera, config)


@pytest.fixture
def live(tmp_path, capfd, monkeypatch):
    """Runs `gsjax live` in this process; returns the exit code, its output and the run's folder."""
    monkeypatch.setattr(engine, "track", standing_still)
    monkeypatch.setattr(engine, "start_scene", unfitted)

    def call(source, *options: str):
        code = main(["live", str(source), "--out", str(tmp_path / "run"), *options])
        out, err = capfd.readouterr()
        assert "Traceback" not in out + err
        return code, out + err, tmp_path / "run"

    return call


@pytest.mark.thorough
def test_a_recording_is_replayed_and_all_frames_are_accounted_for(pristine, live):
    code, said, folder = live(pristine, "--minutes", "0.01", "--hz", "20", "--cameras", "0", "1")
    assert code == 0, said
    found = json.loads((folder / "metrics.json").read_text())
    frames = found["frames"]
    assert frames["offered"] == 12
    assert frames["used"] + frames["dropped"] == 12
    assert found["complete"]
    assert found["skipped"] == 1
    assert "1 update, whose numbers were not finite" in said
    assert found["latency_ms"]["median"] > 0
    assert found["memory_mb"]["max"] > 10
    assert "12 offered" in said
    *followed, last = found["objects"].values()  # the last group is reported lost in every frame
    assert found["frames_lost"] == {**dict.fromkeys(followed, 0), last: frames["used"]}
    assert f"{last} in {frames['used']} updates" in said
    with np.load(folder / "trajectory.npz") as stored:
        assert len(stored["times"]) == len(stored["centers"]) == frames["used"]
        np.testing.assert_allclose(stored["quats"], np.broadcast_to([1, 0, 0, 0], stored["quats"].shape))
        assert stored["lost"][:, -1].all()
        assert not stored["lost"][:, :-1].any()
        assert not stored["turn_known"][:, 0].any()
        assert stored["turn_known"][:, 1:].all()
    code, said, _ = live(pristine, "--minutes", "0.01", "--cameras", "0", "1")
    assert code == 2
    assert "holds a finished run" in said


@pytest.mark.thorough
def test_positions_in_a_recording_far_from_0_are_its_own(pristine, live, tmp_path):
    table, far = open_sequence(pristine), np.array([5e5, 5e6, 300.0])
    moved = replace(table, viewmats=about(table.viewmats, -far), truth=None)
    write_panoptic(moved, tmp_path / "far")
    code, said, folder = live(tmp_path / "far", "--minutes", "0.01", "--hz", "20", "--cameras", "0")
    assert code == 0, said
    with np.load(folder / "trajectory.npz") as stored:
        assert np.abs(stored["centers"] - far).max() < 1e3


def test_a_group_goes_where_it_is_carried_whatever_joins_it():
    """The mean of its points shifts when points join: here by 2 cm, before it rotates by 90 degrees and moves
    by 1 m."""
    log = engine.Log((0, 5), {})
    still, turn = np.zeros((1, 6)), np.array([[1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2]])
    start, joined, moved = (np.array([[x, 0.0, 0.0]]) for x in (0.1, 0.12, 1.12))
    places = [
        log._carried(still, start),
        log._carried(still, joined),
        log._carried(turn, moved),
    ]
    np.testing.assert_allclose(places[0][0, :3], [0.1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(places[1], places[0], atol=1e-6)
    np.testing.assert_allclose(places[2][0, :3], [1.12, -0.02, 0], atol=1e-6)  # 2 cm off the mean, rotated
    np.testing.assert_allclose(places[2][0, 3:], np.sqrt([0.5, 0, 0, 0.5]), atol=1e-6)


@pytest.mark.parametrize(
    ("source", "options", "says"),
    [
        ("camera:x", (), "expected camera:NUMBER"),
        ("camera:97", (), "replay a folder"),
        ("camera:0", ("--cameras", "1"), "--cameras: applies to recordings"),
        (None, ("--hz", "0"), "--hz: expected more than 0"),
        (None, ("--hz", "inf"), "--hz: expected a finite number of frames per second, found inf"),
        (None, ("--cameras", "9"), "has no camera 9"),
    ],
)
def test_what_cannot_be_followed_is_said(pristine, live, source, options, says):
    code, said, _ = live(pristine if source is None else source, *options)
    assert code == 2
    assert says in " ".join(said.split())


def test_a_camera_that_delivers_no_frame_is_named(live, monkeypatch):
    silent = RgbdCamera(SimpleNamespace(grab=lambda: False), np.eye(3), np.eye(4))
    monkeypatch.setitem(engine._CAMERAS, "camera", lambda number, patience: silent)
    code, said, _ = live("camera:0")
    assert (code, "camera:0: expected a frame, found none" in said) == (2, True)


@pytest.mark.parametrize(("source", "ends"), [("camera:0", True), ("recording", False)])
def test_only_a_recording_may_end_by_itself(monkeypatch, source, ends):
    def untracked(scene, first, frames, config, **how):
        for _ in frames:
            pass
        yield from ()

    monkeypatch.setattr(engine, "track", untracked)
    rehearsal, arriving = SimpleNamespace(tick=None), iter([Snapshot(None, 1.0), Snapshot(None, 2.0)])
    stream = engine.Source(None, None, {}, rehearsal, arriving)
    log, options = engine.Log((0, 5), {}), engine.Options(source, Path("run"))
    stopped = engine.follow(options, stream, log, Console(quiet=True))
    assert log.counts["offered"] == 2
    assert isinstance(stopped, StreamStalled) == ends, stopped
    assert not ends or str(stopped).startswith("camera:0: it delivered 3 frames and no more")


@pytest.mark.thorough
def test_a_stream_that_fails_leaves_what_was_followed(pristine, live, monkeypatch):
    def failing(frames, hz, seconds):
        yield from gsjax.data.stream.replay(frames, hz, 0.2)
        raise OSError("the camera was unplugged")

    monkeypatch.setattr(engine, "replay", failing)
    code, said, folder = live(pristine, "--cameras", "0", "--hz", "20")
    assert code == 2
    assert "unplugged" in said
    found = json.loads((folder / "metrics.json").read_text())
    assert not found["complete"]
    assert "unplugged" in found["stopped"]
    assert (folder / "trajectory.npz").exists()


@pytest.mark.thorough
def test_a_picture_names_the_objects_of_a_recording(pristine, live, tmp_path, monkeypatch):
    labels = np.zeros((60, 80), np.uint8)
    labels[20:40, 20:60] = 7
    write_png(tmp_path / "mask.png", labels)
    monkeypatch.chdir(tmp_path)
    told = ("--minutes", "0.01", "--hz", "20", "--masks", "mask.png")
    code, said, folder = live(pristine, *told, "--cameras", "0")
    assert code == 0, said
    assert json.loads((folder / "metrics.json").read_text())["objects"] == {"7": "object 7"}
    assert str(tmp_path / "mask.png") in (folder / "config.yml").read_text()
    code, said, _ = live("camera:0", *told)
    assert (code, "--masks: applies to recordings" in said) == (2, True)
