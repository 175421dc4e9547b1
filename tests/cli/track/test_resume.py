"""A run that was stopped resumes where it was, and ends as if it had not been stopped."""

import errno
import itertools
import json
import shutil
import warnings
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

import gsjax.engine.saving
import gsjax.engine.track.loop
import gsjax.engine.track.resume
from gsjax.data import write_panoptic
from gsjax.data.simulated import tabletop
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.tracking import track
from gsjax.io.checkpoints import CheckpointError
from gsjax.methods.track import Pose, TrackConfig

OPTIONS = ("--cameras", "0", "1", "--preset", "fast", "--track.start.iterations", "5")


def interrupted(after: int):
    """A `track` that Ctrl-C stops after that many updates."""

    def call(*arguments, **options):
        for count, update in enumerate(track(*arguments, **options), start=1):
            yield update
            if count == after:
                raise KeyboardInterrupt

    return call


@pytest.mark.slow
def test_a_stopped_run_goes_on_and_ends_alike_to_the_bit(pristine, gsjax_track, tmp_path, monkeypatch):
    assert gsjax_track(pristine, *OPTIONS)[0] == 0
    whole = np.load(tmp_path / "run" / "trajectory.npz")
    (tmp_path / "run").rename(tmp_path / "whole")

    monkeypatch.setattr(gsjax.engine.track.loop, "track", interrupted(1))
    assert gsjax_track(pristine, *OPTIONS)[0] == 130
    assert (tmp_path / "run" / "resume" / "state.npz").exists()
    monkeypatch.setattr(gsjax.engine.track.loop, "track", track)
    code, said = gsjax_track(pristine, *OPTIONS, "--resume")
    assert code == 0, said
    resumed = np.load(tmp_path / "run" / "trajectory.npz")
    for name in ("means", "quats", "labels", "times"):
        np.testing.assert_array_equal(resumed[name], whole[name], err_msg=name)
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["complete"]
    assert any("Resumed after 2 frames" in note for note in found["notes"])
    assert not (tmp_path / "run" / "resume").exists()


def test_there_must_be_something_to_resume(pristine, gsjax_track, still):
    code, said = gsjax_track(pristine, "--cameras", "0", "--mask-camera", "0", "--resume")
    assert code == 2
    assert "expected a run to resume, found none" in said


@pytest.mark.thorough
def test_other_options_are_no_resuming(pristine, gsjax_track, still, tmp_path):
    assert gsjax_track(pristine, "--cameras", "0", "--frames", "0:2")[0] == 0
    (tmp_path / "run" / "report.html").unlink()
    code, said = gsjax_track(pristine, "--cameras", "0", "--frames", "0:3", "--resume")
    assert code == 2
    assert "was started with frames '0:2', now it is '0:3'" in " ".join(said.split())
    code, said = gsjax_track(pristine, "--cameras", "0", "--frames", "0:2", "--resume")
    assert code == 2
    assert "was stopped before its first update, so nothing was saved; start again" in " ".join(said.split())


@pytest.mark.thorough
def test_a_run_that_cannot_be_resumed_stays_as_it_was(pristine, gsjax_track, still, tmp_path):
    assert gsjax_track(pristine, "--cameras", "0")[0] == 0
    run = tmp_path / "run"
    (run / "resume").mkdir()
    for name in ("metrics.json", "resume/state.npz"):  # as if it had been stopped
        (run / name).write_text('{"complete": false}')
    before = {file: file.read_bytes() for file in run.rglob("*.*") if file.is_file()}
    code, said = gsjax_track(pristine, "--cameras", "0", "--resume")
    assert code == 2
    assert "state.npz: expected a checkpoint, found a file that cannot be read as one" in said
    assert {file: file.read_bytes() for file in run.rglob("*.*") if file.is_file()} == before


def fewer_frames(recording):
    shutil.rmtree(recording)
    recording.mkdir()
    write_panoptic(tabletop(frames=1, width=80, height=60), recording)


def another_picture(recording):
    picture, *_ = sorted((recording / "ims" / "0").iterdir())
    cv2.imwrite(str(picture), 255 - cv2.imread(str(picture)))


@pytest.mark.thorough
@pytest.mark.parametrize("changed", [fewer_frames, another_picture])
def test_another_recording_is_no_resuming(recording, gsjax_track, still, tmp_path, monkeypatch, changed):
    def stopped(*arguments, **options):
        yield from itertools.islice(still(*arguments, **options), 1)
        raise KeyboardInterrupt

    monkeypatch.setattr(gsjax.engine.track.loop, "track", stopped)
    assert gsjax_track(recording, "--cameras", "0")[0] == 130
    changed(recording)
    code, said = gsjax_track(recording, "--cameras", "0", "--resume")
    assert code == 2
    assert "the recording: expected the same as when the run in" in " ".join(said.split())


@pytest.mark.thorough
def test_a_full_disk_is_said_and_tracking_goes_on(pristine, gsjax_track, still, monkeypatch):
    def full(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(gsjax.engine.saving, "EVERY_S", -1.0)
    monkeypatch.setattr(gsjax.engine.track.resume, "write_npz", full)
    code, said = gsjax_track(pristine, "--cameras", "0")
    assert code == 0, said
    assert "could not save what --resume needs" in said
    assert "no space left on device" in said.lower()


def test_parts_whose_state_did_not_follow_are_written_again(tmp_path, monkeypatch):
    """The disk has room for the poses but not for the larger state, or a run is killed between the two."""

    def tracked_up_to(frames: int):
        rows = [Pose(jnp.full((3, 3), float(t)), jnp.full((3, 4), float(t))) for t in range(frames)]
        tick = SimpleNamespace(run=None)
        lists = {
            name: []
            for name in ("joined", "update_s", "visible", "lost", "turn_known", "agrees", "everywhere")
        }
        return Mock(spec=Tracking, poses=rows, num_frames=frames, scene=None, tick=tick, skipped=0, **lists)

    def full(path, *_):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    saver, written = gsjax.engine.track.resume.Saver(tmp_path, {}), []
    for frames, save in ((10, written.append), (20, full), (30, written.append)):
        monkeypatch.setattr(
            gsjax.engine.track.resume, "save_checkpoint", lambda path, *_, save=save: save(path)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            saver(tracked_up_to(frames), last=True)
    assert len(written) == 2
    saved = gsjax.engine.track.resume._saved_poses(tmp_path, 30, tracked_up_to(1).poses[0])
    assert [float(pose.means[0, 0]) for pose in saved] == list(range(1, 30))


def test_a_run_of_another_version_is_refused(monkeypatch, tmp_path):
    """It has not saved all that this version saves of each update."""
    tree = {"scene": None, "run": SimpleNamespace(kept=SimpleNamespace(chosen=None))}
    saved = {"frames": 1, "visible": [], "lost": [], "turn_known": []}
    monkeypatch.setattr(gsjax.engine.track.resume, "load_checkpoint", lambda path: (tree, saved))
    (tmp_path / "state.npz").touch()
    says = r"state\.npz: expected agrees of each update, found a run of .*; start again with --overwrite in"
    with pytest.raises(CheckpointError, match=says):
        gsjax.engine.track.resume.load(tmp_path, TrackConfig(), {})
