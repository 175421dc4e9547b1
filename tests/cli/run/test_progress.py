"""What is noted of a run that ended early, and which resume folders are refused."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from gsjax.engine.messages import Notes
from gsjax.engine.progress import Progress, Schedule, load_run, means_of, note_if_cut_short, save_run
from gsjax.io.checkpoints import CheckpointError
from gsjax.optim.method import Run


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
    np.savez(tmp_path / "state.npz", __header__=np.array(header))
    with pytest.raises(
        CheckpointError, match="found format 1, written by another version of gsjax; start again"
    ):
        load_run(tmp_path, run, progress)
    save_run(tmp_path, run.having(step=3), progress)
    assert load_run(tmp_path, run, progress)[0].step == 3
