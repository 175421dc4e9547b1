"""The size of photographs in a fit of given minutes."""

from dataclasses import replace

import pytest
from rich.console import Console

from gsjax.engine.budget import Budget
from gsjax.engine.fit.sizes import Sizes
from gsjax.engine.messages import Notes
from gsjax.engine.progress import Progress, load_run, save_run
from gsjax.methods.fit import FitConfig
from gsjax.optim.method import Run

CONSOLE = Console(quiet=True)


class Given(Budget):
    """A budget of `seconds` for steps; the test sets how many are left."""

    def __init__(self, seconds):
        super().__init__(seconds / 60, 0.0)
        self.left_s = seconds

    @property
    def steps_s(self):
        return self.left_s


def sizes(seconds, size, config=None, progress=None):
    notes = Notes(CONSOLE)
    progress = progress or Progress()
    return Sizes(config or FitConfig(), size, Given(seconds), progress, notes, CONSOLE), progress, notes


@pytest.mark.parametrize(
    ("seconds", "size", "factor"),
    [
        (600.0, (480, 270), 4),
        (100.0, (480, 270), 4),
        (100.0, (960, 540), 8),
        (60.0, (1600, 900), 16),
        (1.0, (1600, 900), 16),  # smaller ones would have fewer than 32 pixels a side
        (0.5, (100, 80), 4),
    ],
)
def test_a_fit_begins_at_a_quarter_of_the_size_for_which_there_should_be_time(seconds, size, factor):
    assert sizes(seconds, size)[0](0.0) == factor


def test_with_time_the_size_grows_as_in_a_fit_without_minutes():
    factor, progress, notes = sizes(1000.0, (480, 270))
    found = []
    for percent in range(100):
        progress.pace = 20.0
        factor._budget.left_s = 1000.0 - 10 * percent
        found.append(factor(percent / 100))
    assert found == 17 * [4] + 33 * [2] + 50 * [1]
    assert not notes.all


def test_where_larger_photographs_are_slow_they_stay_small_and_it_is_said():
    factor, progress, notes = sizes(100.0, (480, 270))
    found = []
    for percent in range(100):
        progress.pace = 100.0 if found[-1:] == [4] else 5.0  # a step of 270 pixels a side takes 0.7 s
        factor._budget.left_s = 100.0 - percent
        found.append(factor(percent / 100))
    assert sorted(set(found)) == [2, 4]
    assert notes.all == [
        "Photographs stay at 240x135: of 480x270 there would be time for 28 steps, and 150 are needed to "
        "gain by it (--minutes)."
    ]


def test_a_faster_machine_than_the_guess_ends_with_larger_photographs():
    factor, progress, _ = sizes(100.0, (960, 540))
    found = []
    for percent in range(100):
        progress.pace = 500.0
        factor._budget.left_s = 100.0 - percent
        found.append(factor(percent / 100))
    assert [found[i] for i in (0, 20, 60, 80)] == [8, 4, 2, 1]


def test_nothing_is_decided_before_a_step_is_measured():
    factor, progress, _ = sizes(1000.0, (480, 270))
    assert [factor(0.0), factor(0.3), factor(0.6)] == [4, 4, 4]
    progress.pace = 20.0
    assert factor(0.7) == 2


@pytest.mark.parametrize("shrink", [2, 0])  # in the checkpoint; an older one has it only in rows
def test_a_resumed_fit_goes_on_at_its_size(shrink):
    progress = Progress(rows=[{"shrink": 4 if shrink else 2}], shrink=shrink)
    assert sizes(1000.0, (480, 270), progress=progress)[0](0.6) == 2


def test_a_size_chosen_since_the_last_row_is_kept(tmp_path):
    factor, progress, _ = sizes(1000.0, (480, 270))
    assert factor(0.1) == 4
    progress.rows.append({"shrink": factor.now})
    progress.pace = 20.0
    assert factor(0.2) == 2
    save_run(tmp_path, Run(None, None), progress)
    _, progress = load_run(tmp_path, Run(None, None), Progress())
    assert sizes(1000.0, (480, 270), progress=progress)[0](0.2) == 2


def test_what_an_interrupted_fit_decided_is_not_decided_again():
    progress = Progress(rows=[{"shrink": 2}])
    progress.pace = 20.0
    factor = sizes(1000.0, (480, 270), progress=progress)[0]
    assert [factor(0.2), factor(0.4), factor(0.51)] == [2, 2, 1]


def test_a_fit_that_is_never_coarse_is_not_under_minutes_either():
    factor, progress, _ = sizes(1.0, (4000, 3000), replace(FitConfig(), coarse_until=0.0))
    progress.pace = 0.1
    assert [factor(0.0), factor(0.9)] == [1, 1]
