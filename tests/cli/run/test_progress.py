"""What is noted of a run that ended early, and which resume folders are refused."""

import errno
import json
import signal
import threading
from io import StringIO
from time import perf_counter

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import gsjax.engine.progress
from gsjax.data.errors import DataWarning
from gsjax.engine.drive import Tick, drive
from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import Notes
from gsjax.engine.progress import (
    Progress,
    Schedule,
    load_run,
    means_of,
    note_if_cut_short,
    save_run,
    warn_of_mishaps,
    watch,
)
from gsjax.io.checkpoints import CheckpointError
from gsjax.optim.method import Run
from tests.engine.test_drive import WalkConfig, walked
from tests.optim.test_guard import Descent, DescentConfig


@pytest.mark.parametrize(
    ("step", "stopped", "noted"),
    [
        (1200, None, ["Stopped by --minutes after 1,200 of 3,000 steps."]),
        (3000, None, []),
        (1200, KeyboardInterrupt(), []),  # which is noted elsewhere
    ],
)
def test_steps_that_minutes_did_not_allow_are_noted(step, stopped, noted):
    notes = Notes(Console(quiet=True))
    note_if_cut_short(Progress(stopped=stopped), Schedule("distilling", 3000, means_of(), str), step, notes)
    assert notes.all == noted


def test_what_a_version_before_saved_is_refused(tmp_path):
    run, progress = Run(jnp.zeros(2), None), Progress({"the scene": "1"})
    assert load_run(tmp_path, run, progress)[0] is run
    header = json.dumps({"format": 1, "metadata": {}, "sha256": ""})
    np.savez(tmp_path / "step-00000002.npz", __header__=np.array(header))
    with pytest.raises(
        CheckpointError, match="found format 1, written by another version of gsjax; start again"
    ):
        load_run(tmp_path, run, progress)
    save_run(tmp_path, run.having(step=3), progress)
    assert load_run(tmp_path, run, progress)[0].step == 3


def test_inputs_that_changed_are_refused_unless_the_version_before_did_not_look_at_them(tmp_path):
    run, now = Run(jnp.zeros(2), None), Progress({"the scene": "1", "the data": "2"})
    save_run(tmp_path, run.having(step=1), Progress({"the scene": "1"}))
    loaded, progress = load_run(tmp_path, run, now)
    assert loaded.step == 1
    save_run(tmp_path, run.having(step=2), progress)
    for then in (now, Progress({"another scene": "1", "the data": "2"})):
        save_run(tmp_path, run.having(step=3), then)
        with pytest.raises(ValueError, match="expected the same as when the run in"):
            load_run(tmp_path, run, Progress({"the scene": "1", "the data": "3"}))


def test_the_time_of_a_resumed_run_is_that_of_all_its_commands(tmp_path):
    run = Run(jnp.zeros(2), None)
    save_run(tmp_path, run, Progress(begun=perf_counter() - 3600))
    _, progress = load_run(tmp_path, run, Progress(begun=perf_counter() - 60))
    assert progress.found(0)["seconds"]["total"] == pytest.approx(3660, abs=5)


@pytest.mark.parametrize("name", ["state.npz", "parts.npz"])
def test_what_was_saved_under_another_name_is_refused(name, tmp_path):
    (tmp_path / name).write_bytes(b"of another version")
    with pytest.raises(CheckpointError, match=rf"{name}: expected a checkpoint step-\*.npz.* --overwrite in"):
        load_run(tmp_path, Run(jnp.zeros(2), None), Progress({}))


def test_a_row_averages_the_steps_whose_value_is_finite():
    """Regression test: one frame whose mask hides it entirely left the row without PSNR."""
    infos = [{"loss": 1.0, "psnr": np.nan}, {"loss": 3.0, "psnr": np.inf}, {"loss": 2.0, "psnr": 20.0}]
    now = Tick(None, None, Run(jnp.zeros(2), None), {}, 0.0, 0.0)
    assert means_of("psnr")(now, infos) == {"loss": 2.0, "psnr": 20.0}
    assert means_of("psnr")(now, infos[:2]) == {"loss": 2.0, "psnr": None}


def test_a_log_says_when_a_later_step_compiles(tmp_path):
    said, schedule = StringIO(), Schedule("walking", 11, means_of(), lambda row: f"loss {row['loss']:.1f}")
    ticks = walked(WalkConfig(steps=11, sick=2))  # it grows after 4 and 8 steps
    progress = watch(ticks, Progress(), schedule, RunFolder(tmp_path / "run"), Console(file=said))
    lines = [line for line in said.getvalue().splitlines() if "compiling" in line]
    assert lines == [
        "walking; compiling, which takes half a minute the first time",
        "4 of 11 steps: compiling again, for arrays of other sizes",
        "8 of 11 steps: compiling again, for arrays of other sizes",
    ]
    notes = Notes(Console(quiet=True))
    warn_of_mishaps(progress, notes)
    assert notes.all == [
        "Warning: 1 step produced non-finite numbers and changed nothing; if they are many, try lower "
        "learning rates"
    ]


def test_a_row_that_a_full_disk_refuses_is_written_with_the_next(tmp_path, monkeypatch):
    def full(path):
        monkeypatch.undo()
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(gsjax.engine.progress, "atomic_write", full)
    schedule, folder = Schedule("walking", 8, means_of(), str, every=2), RunFolder(tmp_path / "run")
    said = r"could not log a row \(.*metrics\.jsonl: no space left on device\); walking goes on"
    with pytest.warns(DataWarning, match=said):
        progress = watch(walked(), Progress(), schedule, folder, Console(quiet=True))
    assert progress.stopped is None
    rows = [json.loads(line)["step"] for line in folder.metrics_lines.read_text().splitlines()]
    assert rows == [2, 4, 6, 8]


@pytest.mark.skipif(threading.current_thread() is not threading.main_thread(), reason="signals")
def test_ctrl_c_waits_for_the_row_of_a_step(tmp_path):
    def evaluate(now):
        if now.step == 3:
            signal.raise_signal(signal.SIGINT)
        return {"seen": now.step} if now.step == 3 else None

    schedule, folder = Schedule("walking", 8, means_of(), str), RunFolder(tmp_path / "run")
    ticks = walked()
    progress = watch(ticks, Progress(), schedule, folder, Console(quiet=True), evaluate=evaluate)
    assert isinstance(progress.stopped, KeyboardInterrupt)
    assert ticks.run.step == 3
    assert [row["seen"] for row in progress.rows] == [3]


def test_a_loss_that_is_lost_is_mended_counted_and_told(tmp_path):
    method = Descent(DescentConfig(steep_after=430))
    schedule = Schedule("descending", 1000, means_of(), lambda row: f"loss {row['loss']}")  # None where lost
    ticks = drive(method, *method.start())
    progress = watch(ticks, Progress(), schedule, RunFolder(tmp_path / "run"), Console(quiet=True))
    assert progress.stopped is None
    assert progress.returns == ticks.run.guard.returns >= 1
    assert progress.found(1000)["returns"] == progress.returns
    assert progress.found(1000)["settled"] == ticks.run.guard.is_settled
    notes = Notes(Console(quiet=True))
    warn_of_mishaps(progress, notes)
    assert "continued from its best parameters" in notes.all[-1]
