"""What is said of steps that were made."""

from types import SimpleNamespace

import pytest
from rich.console import Console

from gsjax.engine.learning import Course, Learning, say_if_cut_short
from gsjax.engine.messages import Notes


@pytest.mark.parametrize(
    ("step", "stopped", "said"),
    [
        (1200, None, ["Stopped by --minutes after 1,200 of 3,000 steps."]),
        (3000, None, []),
        (1200, KeyboardInterrupt(), []),  # which is said elsewhere
    ],
)
def test_steps_that_minutes_did_not_allow_are_noted(step, stopped, said):
    learning = Learning(SimpleNamespace(step=step), {})
    learning.stopped = stopped
    notes = Notes(Console(quiet=True))
    say_if_cut_short(learning, Course("distilling", 3000, (), str), notes)
    assert notes.all == said
