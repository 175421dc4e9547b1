"""An update compiled while the first scene is fitted serves for the fitted scene."""

import equinox as eqx
import jax
import numpy as np
import pytest

from gsjax.engine.track.rehearsal import Rehearsal
from gsjax.engine.track.tracking import track


@pytest.fixture(scope="module")
def rehearsed(table, started, quick):
    """The frames, and a rehearsal begun with the scene of the first one."""
    _, frames, _ = table()
    rehearsal = Rehearsal(frames[0], quick)
    rehearsal.begin(started)
    return frames, rehearsal


@pytest.mark.thorough
def test_poses_are_those_without_a_rehearsal_and_nothing_is_compiled(rehearsed, started, quick):
    frames, rehearsal = rehearsed
    assert rehearsal.tick() is not None
    (with_one,) = track(started, frames[0], frames[1:2], quick, like=rehearsal.tick)
    assert with_one.compile_seconds < 0.1  # nothing was compiled
    (without,) = track(started, frames[0], frames[1:2], quick)
    for one, other in zip(*map(jax.tree.leaves, (with_one.result.pose, without.result.pose)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_one_that_fails_or_is_not_needed_is_done_without(started, rehearsed, quick):
    frames, _ = rehearsed
    assert Rehearsal(frames[0], quick).tick() is None
    unneeded = Rehearsal(frames[0], quick, needed=False)
    unneeded.begin(started)
    assert unneeded.tick() is None
    failing = Rehearsal(eqx.tree_at(lambda f: f.images, frames[0], frames[0].images[:1]), quick)
    failing.begin(started)
    assert failing.tick() is None
