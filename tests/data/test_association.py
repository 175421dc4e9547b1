import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsjax.data import DataError, DataWarning
from gsjax.data.association import associate, nearest_in_time

ROOT = Path("recording")


def increasing(sizes):
    """Increasing times on a grid of exactly representable floats, so that ties are exact too."""
    ticks = st.lists(st.integers(0, 400), min_size=1, max_size=sizes, unique=True)
    return ticks.map(lambda t: np.array(sorted(t)) / 64.0)


@given(increasing(12), increasing(12))
def test_nearest_is_what_a_search_of_all_finds(times, own):
    found = nearest_in_time(times, own)
    np.testing.assert_array_equal(found, np.abs(own[None] - times[:, None]).argmin(axis=1))


@given(increasing(12), increasing(12), st.integers(0, 60).map(lambda n: n / 64))
def test_every_frame_is_kept_or_counted(first, other, limit):
    usable = np.abs(other[None] - first[:, None]).min(axis=1) <= limit
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if not usable.any():
            with pytest.raises(DataError, match="one clock"):
                associate(ROOT, {"a": first, "b": other}, limit)
            return
        pairs = associate(ROOT, {"a": first, "b": other}, limit)
    np.testing.assert_array_equal(pairs[:, 0], np.flatnonzero(usable))
    assert (np.abs(first[pairs[:, 0]] - other[pairs[:, 1]]) <= limit).all()
    counted = [f"{np.sum(~usable)} of {len(first)} frames are left out" in str(w.message) for w in caught]
    assert counted == [True] * (not usable.all())


def test_the_warning_names_the_stream_that_was_missing():
    streams = {"a": np.arange(5.0), "b": np.arange(5.0), "c": np.array([0.0, 1.0, 4.0])}
    with pytest.warns(
        DataWarning, match=r"2 of 5 frames are left out: 2 without c \(up to 1000 ms off\) within 30 ms"
    ):
        pairs = associate(ROOT, streams, 0.03)
    assert pairs.tolist() == [[0, 0, 0], [1, 1, 1], [4, 4, 2]]


def test_clocks_that_never_meet():
    with pytest.raises(DataError, match=r"found none: at 0.000 s the nearest b is 100 s away.*one clock"):
        associate(ROOT, {"a": np.arange(3.0), "b": np.arange(3.0) + 100}, 0.02)


@pytest.mark.parametrize(
    ("times", "says"),
    [
        ([], "times of b, found none"),
        ([0.0, 2.0, 1.0], r"frame 2 is at 1.0 s after 2.0 s"),
        ([0.0, 1.0, 1.0], r"frame 2 is at 1.0 s after 1.0 s"),
        ([0.0, np.nan], r"frame 1 is at nan s"),
    ],
)
def test_invalid_times_are_refused(times, says):
    with pytest.raises(DataError, match=says):
        associate(ROOT, {"a": np.arange(3.0), "b": np.array(times)}, 0.02)


@pytest.mark.parametrize("limit", [-0.01, float("nan")])
def test_a_limit_without_meaning(limit):
    with pytest.raises(ValueError, match="max_skew: expected seconds, 0 or more"):
        associate(ROOT, {"a": np.arange(3.0)}, limit)
