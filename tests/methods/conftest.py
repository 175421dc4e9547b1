"""Fixtures: simulated tables, small enough for two busy cores, and a quick tracker."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from gsjax.data.simulated import tabletop
from gsjax.methods.track import (
    PRESETS,
    MatchConfig,
    RefineConfig,
    TrackConfig,
    start_scene,
)
from gsjax.methods.track.points import pixels_of_groups
from tests.methods.track.carton import CARTON, CONFIG, SIZE, middle, see

QUICK = replace(
    PRESETS["paper"],
    start=replace(PRESETS["paper"].start, iterations=5),
    match=MatchConfig(patch=32, radius=12),
    refine=RefineConfig(iterations=3),
)


@cache
def _table(frames: int, cameras: int, width: int, height: int, still: bool, leave: bool, hide: bool):
    sequence = tabletop(0, frames, width, height, cameras, still=still, leave=leave, hide=hide)
    return sequence, [sequence.frame(t) for t in range(frames)], sequence.mask(0, 0)


@pytest.fixture(scope="session")
def quick() -> TrackConfig:
    return QUICK


@pytest.fixture(scope="session")
def table():
    """table(frames, cameras) -> (sequence, its frames, the first mask of camera 0), kept between tests."""

    def make(frames=4, cameras=2, width=96, height=72, still=False, leave=False, hide=False):
        return _table(frames, cameras, width, height, still, leave, hide)

    return make


@pytest.fixture(scope="session")
def started(table):
    """The initial scene of the table seen by 2 cameras."""
    _, frames, mask = table()
    return start_scene(frames[0], mask, 0, QUICK)


@pytest.fixture(scope="session")
def moved(table):
    """(points of the carton in frame 6, their centre, frame 7, the points' true positions in frame 7,
    labels that are 1 on the carton in the masks of frame 6)."""
    sequence, frames, _ = table(8, 2, **SIZE)
    labels = np.stack([sequence.mask(6, c) for c in range(2)])
    labels = jax.device_put(np.where(labels == CARTON, 1, 0).astype(np.int32))
    pixels = jax.jit(pixels_of_groups, static_argnums=(3, 4))
    points = pixels(see(frames[6]), labels, frames[6].depths, 1, CONFIG)
    k = sequence.truth.names.index("carton")
    motion = sequence.truth.poses[7, k] @ np.linalg.inv(sequence.truth.poses[6, k])
    one = jax.tree.map(lambda a: np.asarray(a)[0], points)
    then = np.einsum("ij,cjp->cip", motion[:3, :3], np.asarray(one.means, np.float64)) + motion[:3, 3:]
    return one, middle(one), see(frames[7]), then, labels


@pytest.fixture(scope="session")
def centroid_errors():
    """errors(sequence, scene, pose, t) -> distance of the mean of each object's Gaussians from its true
    position, metres."""

    def errors(sequence, scene, pose, t: int) -> dict[str, float]:
        labels = np.asarray(scene.labels[: scene.num_moving])
        start = np.asarray(scene.gaussians.means[: scene.num_moving])
        now = np.asarray(pose.means[: scene.num_moving])  # without Gaussians that have joined since
        result = {}
        for k, (name, value) in enumerate(zip(sequence.truth.names, sequence.truth.label_ids, strict=True)):
            member = labels == scene.label_ids.index(int(value))
            motion = sequence.truth.poses[t, k] @ np.linalg.inv(sequence.truth.poses[0, k])
            wanted = start[member] @ motion[:3, :3].T + motion[:3, 3]
            result[name] = float(np.linalg.norm(now[member].mean(0) - wanted.mean(0)))
        return result

    return errors
