"""Depth moved from the camera that measured it to another one."""

import tracemalloc

import numpy as np
import pytest

from gsjax.data import registration
from gsjax.data.registration import register_depth
from gsjax.geometry.cameras import intrinsics


def test_bands_of_rows_change_nothing(monkeypatch):
    depth = np.random.default_rng(0).uniform(1, 2, (20, 30)).astype(np.float32)
    depth[3, 4:9] = 0
    moved = np.eye(4)
    moved[:3, 3] = 0.1, 0.05, -0.02
    cameras = intrinsics(25.0, 30, 20), intrinsics(60.0, 80, 50), moved, 80, 50
    whole = register_depth(depth, *cameras)
    monkeypatch.setattr(registration, "_AT_ONCE", 700)
    np.testing.assert_array_equal(register_depth(depth, *cameras), whole)
    assert (whole > 0).any()


@pytest.mark.thorough
def test_memory_is_bounded_whatever_the_ratio_of_focal_lengths():
    """256 points per pixel make 31 million points."""
    depth = np.ones((300, 400), np.float32)
    tracemalloc.start()
    register_depth(depth, intrinsics(10.0, 400, 300), intrinsics(1e6, 400, 300), np.eye(4), 400, 300)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 256e6
