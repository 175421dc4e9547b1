"""Simulated tables, small enough for two busy cores, and a quick tracker."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gsjax.data.simulated import tabletop
from gsjax.methods.object_tracker import (
    PRESETS,
    MatchConfig,
    RefineConfig,
    StartConfig,
    TrackerConfig,
    start_scene,
)

QUICK = replace(
    PRESETS["paper"],
    start=StartConfig(iterations=5),
    match=MatchConfig(patch=32, radius=12),
    refine=RefineConfig(iterations=3),
)


@cache
def _table(frames: int, cameras: int, width: int, height: int, still: bool, leave: bool, hide: bool):
    sequence = tabletop(0, frames, width, height, cameras, still=still, leave=leave, hide=hide)
    return sequence, [sequence.frame(t) for t in range(frames)], sequence.mask(0, 0)


@pytest.fixture(scope="session")
def quick() -> TrackerConfig:
    return QUICK


@pytest.fixture(scope="session")
def table():
    """table(frames, cameras) -> (sequence, its frames, the first mask of camera 0), kept between tests."""

    def make(frames=4, cameras=2, width=96, height=72, still=False, leave=False, hide=False):
        return _table(frames, cameras, width, height, still, leave, hide)

    return make


@pytest.fixture(scope="session")
def started(table):
    """The started scene of the table of 2 cameras."""
    _, frames, mask = table()
    return start_scene(frames[0], mask, 0, QUICK)


@pytest.fixture(scope="session")
def centroid_errors():
    """Metres between where each simulated object has gone and where the Gaussians of its label have."""

    def errors(sequence, scene, pose, t: int) -> dict[str, float]:
        labels = np.asarray(scene.labels[: scene.num_moving])
        start = np.asarray(scene.gaussians.means[: scene.num_moving])
        now = np.asarray(pose.means[: scene.num_moving])  # without what has joined since
        result = {}
        for k, (name, value) in enumerate(zip(sequence.truth.names, sequence.truth.label_ids, strict=True)):
            member = labels == scene.label_ids.index(int(value))
            motion = sequence.truth.poses[t, k] @ np.linalg.inv(sequence.truth.poses[0, k])
            wanted = start[member] @ motion[:3, :3].T + motion[:3, 3]
            result[name] = float(np.linalg.norm(now[member].mean(0) - wanted.mean(0)))
        return result

    return errors
