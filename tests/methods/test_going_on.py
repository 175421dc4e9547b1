"""Runs that are resumed from a tick with other settings than it was made with."""

from dataclasses import replace

import numpy as np
import pytest

import gsjax
from gsjax.methods.fit import FitConfig, GrowthConfig, StartConfig
from gsjax.methods.track import AlignConfig

GROWTH = GrowthConfig(begin=2, every=2, factor=1.5)
FIT = FitConfig(
    steps=8, cap=60, sh_degree=0, coarse_until=0.0, growth=GROWTH, start=StartConfig(count=60, source="depth")
)


@pytest.fixture(scope="module")
def photographs():
    return gsjax.open_photographs("simulated:tabletop?width=32&height=24&frames=1")


@pytest.fixture(scope="module")
def half(photographs):
    for now in gsjax.fit(photographs, FIT):
        if now.step == 4:
            return now


@pytest.mark.thorough
def test_a_fit_takes_more_slots_where_the_cap_is_larger(photographs, half):
    *_, now = gsjax.fit(photographs, replace(FIT, cap=90), after=half)
    assert half.run.params.gaussians.num == 60
    assert now.run.params.gaussians.num == 90
    assert now.result.num > 60


@pytest.mark.thorough
@pytest.mark.parametrize("setting", ["exposure", "refine_poses"])
def test_a_fit_that_would_train_something_else_is_refused(photographs, half, setting):
    with pytest.raises(
        ValueError, match=f"expected a run with {setting}=True.* found one with {setting}=False"
    ):
        gsjax.fit(photographs, replace(FIT, **{setting: True}), after=half)


@pytest.mark.thorough
def test_a_tracker_of_other_settings_looks_anew_where_it_remembers_other_things(table, started, quick):
    _, frames, _ = table()
    align = AlignConfig(iterations=2, reach=0.0, turns=(), pixels=32, centers=32)
    refine = replace(quick.refine, iterations=0)
    config = replace(quick, align=align, refine=refine, matching=False, headroom=1.53)
    (before,) = gsjax.track(started, frames[0], frames[1:2], config)
    other = replace(config, redraw="moving", coarseness=2)
    (now,) = gsjax.track(started, frames[1], frames[2:3], other, after=before)
    assert now.step == before.step + 1
    assert np.isfinite(now.result.pose.means).all()
