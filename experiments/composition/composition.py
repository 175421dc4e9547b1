"""Object tracker, feature distillation and graph in one jitted step: what is the graph worth?"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

import gsjax
from experiments.composition.one_step import composed, empty_memory
from experiments.shared.fields import codebook_of, true_labels
from experiments.shared.recordings import recorded
from experiments.shared.timing import CALLS, jitted, timed
from gsjax.data.photographs import photographs_of
from gsjax.geometry.cameras import Camera
from gsjax.methods.deform import GraphConfig, nodes_of
from gsjax.methods.track import (
    PRESETS,
    FrameShape,
    GrowConfig,
    StartConfig,
    Track,
    TrackBatch,
    Tracked,
    start_scene,
)
from gsjax.metrics.segmentation import LabelOverlap
from gsjax.optim.method import Run
from gsjax.scene.frame import Frame, part_of
from gsjax.scene.render import plan_render, render

RECORDING = "tabletop_1"
CAMERAS, MASK_CAMERA, HELD_OUT, EVERY = (0, 1), 1, 2, 6
TRACKER = replace(
    PRESETS["fast"],
    start=StartConfig(object_pixels=2.5, background_pixels=6.0, iterations=60),
    grow=GrowConfig(slots=0),  # Gaussians that joined would have no features
)
NODES, CHANNELS, RADIUS, RATE = 16, 8, 0.5, 0.03  # nodes of each group; metres
WARM = 10  # frames after which all classes have been learned, whatever the noise
PATCH = 16  # pixels of the picture
GRAPHS = {
    "none": GraphConfig(kind="none"),
    "SurstSplat's": GraphConfig(kind="matching"),
    "its node loss alone": GraphConfig(kind="matching", structure=0.0),
    "GaussianClin's": GraphConfig(kind="similarity"),
}


class Problem(NamedTuple):
    """The recording, and everything that stays fixed while it is tracked."""

    frames: list[Frame]
    masks: np.ndarray  # [T,C,H,W]
    scene: Any
    nodes: Any
    codebook: np.ndarray
    truth: np.ndarray  # the class of each Gaussian
    held_out: list[tuple[Any, np.ndarray]]  # camera and true mask of every sixth frame
    shape: FrameShape
    first: Run  # of the tracker, before it has seen a frame


@cache
def problem() -> Problem:
    """The problem, made once for all cells."""
    recording = gsjax.open_sequence(recorded(RECORDING))
    seen = recording.select(cameras=CAMERAS)
    frames = [seen.frame(t) for t in range(seen.num_frames)]
    masks = np.array([[seen.mask(t, c) for c in range(len(CAMERAS))] for t in range(seen.num_frames)])
    scene = start_scene(frames[0], seen.mask(0, MASK_CAMERA), MASK_CAMERA, TRACKER)
    at_first = photographs_of(recording.select(frames=slice(0, 1)))
    _, codes = codebook_of(at_first)
    _, _, axes = np.linalg.svd(codes, full_matrices=False)
    codebook = np.zeros((len(codes), CHANNELS), np.float32)
    codebook[:, : len(axes)] = codes @ axes.T  # preserves lengths and angles
    nodes = nodes_of(scene.gaussians, NODES, np.asarray(scene.labels))
    alone = recording.select(cameras=(HELD_OUT,))
    held_out = [(alone.frame(t).cameras, alone.mask(t, 0)) for t in range(0, seen.num_frames, EVERY)]
    return Problem(
        frames,
        masks.astype(np.int32),
        scene,
        nodes,
        codebook,
        true_labels(scene.gaussians, at_first),
        held_out,
        *Track(TRACKER).start(scene, frames[0]),
    )


@cache
def stepper(graph: str, shrink: int) -> tuple[Callable, tuple, Camera]:
    """The jitted step with a kind of graph, its first state, and the cameras that features are rendered
    in."""
    p, config = problem(), GRAPHS[graph]
    tracker = Track(TRACKER).step(p.shape)
    views = part_of(p.frames[0], shrink=shrink).cameras
    plan = plan_render(p.scene.gaussians, views, headroom=2.0)
    how = (jnp.asarray(p.codebook), RADIUS, optax.adam(RATE), config, plan)
    _, init, step = composed(tracker, p.nodes, *how)
    features = jnp.zeros((len(p.nodes.rows), CHANNELS))
    memory = empty_memory(2 * config.window + 1, len(p.nodes.rows))
    return jitted(step), (p.first.params, p.first.state, features, init(features), memory), views


def noisy(mask: np.ndarray, kind: str, share: float, random: np.random.Generator) -> np.ndarray:
    """A teacher's labels of a picture: a simulated stand-in for a model with new errors in every picture.

    Args: mask: true labels [H,W], 0 the background. kind: units that are mislabelled as a whole: "things",
    each class in a picture, or "patches" of 16 pixels. share: the share of units with a wrong label. random:
    random generator.
    """
    count = int(problem().masks.max()) + 1
    if kind == "things":
        wrong = np.where(random.random(count) < share, random.integers(1, count, count), 0)[mask]
    else:
        grid = tuple(size // PATCH for size in mask.shape)
        coarse = np.where(random.random(grid) < share, random.integers(1, count, grid), 0)
        wrong = np.kron(coarse, np.ones((PATCH, PATCH), int))
    return ((mask + wrong) % count).astype(np.int32)


def run(options: dict[str, Any], seed: int, folder: Path) -> dict[str, Any]:
    """One pass over the recording, a step a frame; labels are scored against the truth after each."""
    shrink = int(options["shrink"])
    p, (step, state, views) = problem(), stepper(options["graph"], shrink)
    random, cells = np.random.default_rng(seed), slice(shrink // 2, None, shrink)
    taught = [[noisy(one, options["wrong"], options["share"], random) for one in pair] for pair in p.masks]
    in_space, overlap = [], LabelOverlap()
    for t in range(len(p.frames)):  # the tracker only looks at the first
        batch, key = TrackBatch(p.frames[t], p.first.plans["track"]), jax.random.key(t)
        given = batch, views, jnp.asarray(np.stack(taught[t])[:, cells, cells]), jnp.float32(t / 10), key
        state, info = step(state, *given)
        assert not bool(info["skipped"] | info["overflow"].any())
        labels = labels_of_gaussians(state[2])
        in_space.append(of_gaussians(labels, p.truth))
        if t % EVERY == 0 and t >= WARM:
            camera, true = p.held_out[t // EVERY]
            overlap.add(drawn_labels(state[0], labels, camera), true)
    assert step._cache_size() == 1  # nothing is compiled between frames
    ms, without_ms = durations(options["graph"], shrink, given)
    things = range(1, len(p.codebook))
    late = in_space[WARM:]
    return {
        "iou": overlap.mean_iou(things),
        "iou_3d": np.mean(late),
        "least_iou_3d": min(late),
        "early_iou_3d": np.mean(in_space[1:WARM]),
        "step_ms": ms,
        "times_without": ms / without_ms,
        "losses": [f"{k}: {np.asarray(v).mean():.4f}" for k, v in info.items() if k != "overflow"],
        "over_time": [f"{value:.3f}" for value in in_space],
        "things": [f"{k}: {overlap.iou(k):.2f}" for k in things],
    }


def durations(graph: str, shrink: int, given: tuple) -> tuple[float, float]:
    """Median milliseconds of a step with this graph and of one without a graph, called in turn."""
    steps = [stepper(kind, shrink) for kind in (graph, "none")]
    took = [[timed(step, state, *given)[1] for step, state, _ in steps] for _ in range(CALLS + 1)]
    ours, without = np.median(took[1:], axis=0)  # the first may compile
    return float(ours), float(without)


def labels_of_gaussians(features: jax.Array) -> np.ndarray:
    """The class nearest to each Gaussian's blended feature."""
    p = problem()
    blended = np.einsum("nk,nkc->nc", np.asarray(p.nodes.weights), np.asarray(features)[p.nodes.indices])
    return (blended @ p.codebook.T).argmax(axis=1)


def of_gaussians(labels: np.ndarray, truth: np.ndarray) -> float:
    """Mean IoU over all classes except the background, for Gaussians whose class is known."""
    overlap = LabelOverlap()
    overlap.add(labels, truth)
    return overlap.mean_iou(range(1, int(truth.max()) + 1))


@jax.jit
def _shares(gaussians, camera, plan, classes):
    drawn = render(gaussians, camera, plan, features=classes)
    assert drawn.features is not None
    return drawn.features[0]


@cache
def _held_out_plan():
    p = problem()
    return plan_render(p.scene.gaussians, p.held_out[0][0], headroom=2.0)


def drawn_labels(tracked: Tracked, labels: np.ndarray, camera: Any) -> np.ndarray:
    """The class with the largest share of each pixel of the held-out camera."""
    p = problem()
    classes = jax.nn.one_hot(labels, len(p.codebook))
    shares = _shares(tracked.gaussians(), camera, _held_out_plan(), classes)
    return np.asarray(shares.argmax(axis=-1))
