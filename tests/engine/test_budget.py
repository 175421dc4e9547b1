"""How a command spends the minutes that it is given."""

import numpy as np
import pytest
from rich.console import Console

from gsjax.engine import budget as module
from gsjax.engine.budget import REPORT_S, Budget, note_if_few
from gsjax.engine.messages import Notes


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test sets."""

    class Clock:
        now = 1000.0

    monkeypatch.setattr(module, "perf_counter", lambda: Clock.now)
    return Clock


def begun(clock, minutes, *, used=0.0, earlier=0.0):
    """A budget whose steps begin after `used` seconds, the start of the program included."""
    budget = Budget(minutes, clock.now + module._LOADING_S)
    clock.now += used
    budget.begin_steps(earlier, Console(quiet=True))
    return budget


def test_without_minutes_there_is_time_for_everything(clock):
    budget = begun(clock, None, used=1e6)
    clock.now += 1e9
    assert (budget.share, budget.is_over, budget.left) == (0.0, False, np.inf)
    assert budget.allows(1e12)
    assert list(budget.affordable(range(5))) == [0, 1, 2, 3, 4]
    assert list(budget.guarded(range(5), 1e12)) == [0, 1, 2, 3, 4]


def test_steps_get_what_opening_and_the_end_leave(clock):
    budget = begun(clock, 2.0, used=20.0)
    assert budget.share == 0
    clock.now += 41
    assert budget.share == pytest.approx(0.5)  # of 120 - 20 - 18 seconds
    clock.now += 41
    assert budget.is_over
    assert budget.left == pytest.approx(18)


def test_the_end_keeps_no_more_than_it_needs_and_the_share_never_falls(clock):
    budget = begun(clock, 10.0)
    clock.now += 60
    first = budget.share
    budget.rest_s = lambda most: min(most, 20.0)
    assert budget.share == first > 60 / 580
    clock.now += 519
    assert not budget.is_over
    clock.now += 1
    assert budget.is_over
    budget.rest_s = lambda most: 0.0
    assert budget.is_over


def test_a_slow_start_leaves_a_quarter_for_steps(clock):
    budget = begun(clock, 1.0, used=300.0)
    assert not budget.is_over
    clock.now += 15
    assert budget.is_over


def test_earlier_steps_of_a_resumed_run_count(clock):
    budget = begun(clock, 2.0, earlier=51.0)
    assert budget.share == pytest.approx(0.5)
    assert budget.left == pytest.approx(69)


def test_a_run_that_used_all_its_minutes_needs_more_to_be_resumed(clock):
    with pytest.raises(ValueError, match=r"--minutes 2: the steps of the run to resume took 2.5 min already"):
        Budget(2.0, clock.now).check_exceeds(150.0)
    Budget(None, clock.now).check_exceeds(150.0)


def test_what_is_not_necessary_is_done_if_it_can_end_in_time(clock):
    budget = begun(clock, 1.0, used=50.0)
    assert budget.allows(10 - REPORT_S)
    assert not budget.allows(10 - REPORT_S + 0.1)
    assert not budget.allows(1.0, keep=9.5)
    assert budget.allows(1.0, keep=8.5)
    budget.hurried = True
    assert not budget.allows(0.0)


def test_of_many_items_as_many_as_there_is_time_for_are_taken_evenly_spread(clock):
    budget, taken = begun(clock, 1.0, used=60 - REPORT_S - 7), []
    for item in budget.affordable(range(100)):
        taken.append(item)
        clock.now += 2 if item == 0 else 1  # the first compiles
    assert taken == [0, 1, 2, 34, 67, 99]
    clock.now += 1
    assert list(budget.affordable(range(3))) == [0]  # always at least one


def test_items_that_are_all_needed_stop_where_time_ends(clock):
    budget, done = begun(clock, 1.0), []

    def work():
        for item in budget.guarded(range(100), keep=10.0):
            done.append(item)
            clock.now += 1

    with pytest.raises(TimeoutError, match="no time was left for it"):
        work()
    assert len(done) == 51


def test_scores_of_some_are_noted():
    notes = Notes(Console(quiet=True))
    note_if_few([1, 2], [1, 2], "held-out views", notes)
    assert not notes.all
    note_if_few([1], [1, 2, 3], "held-out views", notes)
    assert notes.all == ["1 of 3 held-out views were scored: --minutes left no time for more."]
