"""Budgets are met by the choice of a rung and by omitting searches, and delays are compensated."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax import track
from gsjax.methods.track import PRESETS, GrowConfig, StartConfig, TrackConfig
from gsjax.methods.track.budget import Costs, Governor, choose, ladder, unused_settings

RUNGS = ladder(TrackConfig(), 3)
NAMES = list(RUNGS)


def measured(**base_ms):
    """(a stand-in for measuring, which returns the given cost of a rung; the rungs it was called for)."""
    calls = []

    def measure(config):
        name = next(n for n in NAMES if RUNGS[n] is config)
        calls.append(name)
        milliseconds = base_ms.get(name.replace(",", "").replace(" ", "_"), 10.0)
        return Costs(milliseconds / 1e3, milliseconds / 1e4)

    return measure, calls


COSTS = {
    "accurate": 1000.0,
    "balanced": 100.0,
    "fast": 20.0,
    "fast_half_the_resolution": 10.0,
    "fast_half_the_resolution_2_cameras": 7.0,
    "fast_half_the_resolution_1_camera": 4.0,
}


def test_every_rung_has_the_seed_of_the_settings():
    assert {rung.seed for rung in ladder(TrackConfig(seed=3), 2).values()} == {3}


def test_the_ladder_goes_from_the_richest_to_one_camera():
    assert NAMES[:3] == ["accurate", "balanced", "fast"]
    assert NAMES[-1] == "fast, half the resolution, 1 camera"
    assert RUNGS[NAMES[-1]].cameras == (0,)
    few = ladder(TrackConfig(grow=GrowConfig(slots=7)), 3).values()
    assert [rung.grow.slots for rung in few] == [7] * len(RUNGS)
    assert set(PRESETS) - {"paper"} <= set(NAMES)


@pytest.mark.parametrize(
    ("budget_ms", "expected", "fits", "most_measured"),
    [
        (33.0, "fast", True, 1),
        (60.0, "fast", True, 1),  # fast fits with all groups, but not at twice its cost
        (100.0, "fast", True, 2),  # at twice its cost too; balanced does not
        (250.0, "balanced", True, 2),
        (5000.0, "accurate", True, 3),
        (15.0, "fast, half the resolution", True, 2),
        (5.5, "fast, half the resolution, 1 camera", True, 4),
        (1.0, "fast, half the resolution, 1 camera", False, 4),
    ],
)
def test_the_richest_rung_that_fits_is_chosen(budget_ms, expected, fits, most_measured):
    measure, calls = measured(**COSTS)
    chosen = choose(RUNGS, measure, budget_ms / 1e3, 9)
    assert (chosen.name, chosen.fits) == (expected, fits)
    assert chosen.config is RUNGS[expected]
    assert len(calls) == len(set(calls)) == len(chosen.tried) <= most_measured


def test_as_many_groups_are_searched_for_as_there_is_time_for():
    assert Governor(0.033, Costs(0.010, 0.004), 9).allowed() == 4
    assert Governor(0.100, Costs(0.010, 0.004), 9).allowed() == 9
    assert Governor(0.010, Costs(0.020, 0.004), 9).allowed() == 0


def test_a_delay_is_compensated_and_then_forgotten():
    governor, costs = Governor(0.033, Costs(0.010, 0.004), 9), Costs(0.010, 0.004)
    governor.spent(0.048, 4)  # something else took the processor
    allowed = []
    for _ in range(12):
        allowed.append(governor.allowed())
        governor.spent(costs.base + allowed[-1] * costs.search, allowed[-1])
    assert allowed[0] < 3
    assert allowed[-1] >= 3
    assert allowed == sorted(allowed)


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=60))
def test_a_governor_always_recovers(hiccups):
    """However late updates were, 60 undisturbed ones suffice until groups are searched for again."""
    governor, costs = Governor(0.033, Costs(0.010, 0.004), 9), Costs(0.010, 0.004)
    for hiccup in hiccups:
        count = governor.allowed()
        assert 0 <= count <= 9
        governor.spent(costs.base + count * costs.search + hiccup, count)
    for _ in range(60):
        count = governor.allowed()
        governor.spent(costs.base + count * costs.search, count)
    assert governor.allowed() >= 3


@pytest.mark.thorough
def test_a_budget_of_nothing_is_refused(table, started):
    _, frames, _ = table()
    with pytest.raises(ValueError, match="budget_ms: expected milliseconds above 0, found -1"):
        next(track(started, frames[0], frames[1:], budget_ms=-1))


def test_settings_that_a_budget_does_not_use_are_named():
    assert unused_settings(TrackConfig()) == []
    assert "refine.iterations" in unused_settings(PRESETS["paper"])
    mine = TrackConfig(
        start=StartConfig(iterations=3), grow=GrowConfig(slots=9, reach=7), seed=4, headroom=3.0, coarseness=7
    )
    assert unused_settings(mine) == ["grow.reach", "coarseness"]


@pytest.mark.filterwarnings("ignore:under a budget")
@pytest.mark.thorough
def test_costs_are_measured_with_the_second_frame(table, started, monkeypatch):
    """With moving cameras, updates with the first frame again would leave out redrawing the background."""
    _, frames, _ = table()

    class Measured(Exception):
        pass

    def measured(start, second, config):
        raise Measured(second)

    monkeypatch.setattr("gsjax.engine.track.tracking._measured_costs", measured)
    for following, expected in ((frames[1:], frames[1]), ([], frames[0])):
        with pytest.raises(Measured) as seen:
            next(track(started, frames[0], following, budget_ms=33.0))
        assert seen.value.args[0] is expected


@pytest.mark.filterwarnings("ignore:under a budget")
@pytest.mark.slow
def test_objects_are_followed_within_a_generous_budget(table, started, quick, centroid_errors):
    sequence, frames, _ = table()
    for t, now in enumerate(track(started, frames[0], frames[1:], quick, budget_ms=100.0), start=1):
        assert max(centroid_errors(sequence, started, now.result.pose, t).values()) < 5e-3
        assert now.run.kept.chosen.name in ladder(quick, 2)
        assert 0 <= now.info["looked_for"].sum() <= started.num_objects
