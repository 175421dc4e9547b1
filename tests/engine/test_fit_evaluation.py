"""When held-out photographs are evaluated during a fit, and at which size photographs are fitted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from gsjax.data import open_photographs
from gsjax.engine.budget import Budget
from gsjax.engine.drive import Tick
from gsjax.engine.fit import schedule as module
from gsjax.engine.fit.judge import Judge, Scores
from gsjax.engine.fit.run import _at_scale
from gsjax.engine.fit.schedule import Evaluation
from gsjax.engine.messages import Notes
from gsjax.methods.fit import Fit, FitConfig
from gsjax.optim.method import Run


class Given(Budget):
    """A budget of 100 s; the test sets how much of it is used."""

    spent = 0.0

    @property
    def used(self):
        return self.spent

    @property
    def share(self):
        return self.spent / 100


@pytest.fixture
def evaluate(monkeypatch):
    """Makes an evaluation every 10 steps; the first takes 20 s, the others 3 s each."""
    budget, clock = Given(100 / 60, 0.0), SimpleNamespace(now=0.0, first=True)

    class Slow(Judge):
        def __call__(self, gaussians, frames, folder=None):
            clock.now += 20.0 if clock.first else 3.0
            clock.first = False
            return Scores([{"psnr": 20.0}])

    monkeypatch.setattr(module, "perf_counter", lambda: clock.now)

    def make(awaited):
        evaluation = Evaluation(Slow(FitConfig(), None), ["view"], 10, 1000, awaited, budget)

        def after(step, used):
            budget.spent = used
            run = Run(SimpleNamespace(gaussians=None), None, step)
            return evaluation(Tick(Fit(), None, run, {}, 0.0, 0.0)) is not None

        return after

    return make


def test_compiling_for_the_first_evaluation_does_not_prevent_the_others(evaluate):
    after = evaluate(awaited=False)
    assert after(10, 5.0)  # takes 20 s, as it compiles
    assert after(20, 25.0)
    assert not after(30, 26.0)  # 3 s of 26 are more than a twentieth
    assert after(40, 70.0)


def test_a_score_that_is_awaited_is_never_left_out(evaluate):
    after = evaluate(awaited=True)
    assert all(after(step, 5.0 + step / 10) for step in (10, 20, 30, 40))
    assert not after(41, 9.1)


def test_the_last_step_is_evaluated_whatever_it_takes(evaluate):
    after = evaluate(awaited=False)
    found = [after(step, used) for step, used in ((10, 5.0), (20, 6.0), (30, 7.0), (35, 100.0))]
    assert found == [True, True, False, True]


def test_one_large_photograph_does_not_shrink_the_others():
    photographs = open_photographs("simulated:tabletop?width=32&height=24&frames=1")
    sizes = np.array(photographs.sizes)
    sizes[0] = (3200, 2400)
    notes = Notes(Console(quiet=True))
    scaled = _at_scale(replace(photographs, sizes=sizes), None, notes, Console(quiet=True))
    assert scaled.sizes[0].tolist() == [1600, 1200]
    assert (scaled.sizes[1:] == sizes[1:]).all()
    (note,) = notes.all
    of_all = f"(1 of {len(sizes)} are so large)"
    assert note.startswith(f"Photographs of 3200x2400 are fitted at 1600x1200 {of_all}; for more")
    assert _at_scale(photographs, None, notes, Console(quiet=True)) is photographs
