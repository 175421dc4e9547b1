"""The pictures that steps see: of the frame that is being found, of the past, and of all frames in the end.
They are loaded on demand and kept on the host or on the device as long as they are needed."""

from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.parts.discovery import Discovery
from gsjax.methods.parts.stream import Canonical, counted
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.protocols import SequenceLike
from gsjax.scene.frame import Frame, one_camera, part_of
from gsjax.scene.handles import Blend, HandlePose, skin
from gsjax.scene.region import TILE, tiles_to_pixels, touched_tiles

WHOLE, HALF = 1, 2
"""Sizes of pictures, by how many times smaller they are than in the data."""
_CAMERAS = 4  # of a frame that are used before another frame is opened


class Problem(NamedTuple):
    """What does not change during a discovery; see `problem_of`.

    Attributes:
        sequence: what synchronised cameras saw.
        past: frames of the past at half the size, on the host, colours in bytes; filled on demand.
        now: by size, the frame that is being found, and the weights that say which of its pixels count.
        whole: the frame that all frames' step sees, by its index.
    """

    sequence: SequenceLike
    past: dict[int, Frame]
    now: dict[int, tuple[Array, Frame]]
    whole: dict[int, Frame]


def problem_of(sequence: SequenceLike) -> Problem:
    """The problem of a recording, of which nothing is loaded yet."""
    return Problem(sequence, {}, {}, {})


class Draws(NamedTuple):
    """What a frame's steps draw at random.

    Attributes:
        cameras: of each step.
        past: of each step, (frame, camera) of each picture of the past.
    """

    cameras: list[int]
    past: list[list[tuple[int, int]]]


@lru_cache(maxsize=8)
def draws_of(seed: int, t: int, cameras: int, past: tuple[int, ...], count: int, steps: int) -> Draws:
    """The cameras and pictures of the past of all steps of frame t: all cameras take turns in a random order,
    and then in another. The same arguments give the same draws.

    Args:
        seed: of the discovery.
        t: the frame.
        cameras: how many there are.
        past: frames to draw from.
        count: pictures of the past in a step.
        steps: of the frame.
    """
    rng = np.random.default_rng((seed, t))
    order = np.concatenate([rng.permutation(cameras) for _ in range(64)])
    turns = [int(order[i % len(order)]) for i in range(steps)]
    drawn = [
        [(int(rng.choice(np.array(past))), int(rng.integers(cameras))) for _ in range(count)]
        for _ in range(steps)
    ]
    return Draws(turns, drawn)


@lru_cache(maxsize=8)
def order_of_pictures(seed: int, frames: tuple[int, ...], cameras: int, steps: int) -> list[tuple[int, int]]:
    """(frame, camera) of each step that refines all frames, several cameras of a frame in a row.

    Args:
        seed: of the discovery.
        frames: to draw from.
        cameras: how many there are.
        steps: in all.
    """
    rng, order = np.random.default_rng((seed, 1)), []
    while len(order) < steps:
        t = int(rng.choice(np.array(frames)))
        order += [(t, int(c)) for c in rng.permutation(cameras)[:_CAMERAS]]
    return order[:steps]


def frame_now(problem: Problem, discovery: Discovery, size: int, blend: Blend) -> Frame:
    """The frame that is being found, by all cameras.

    Args:
        problem: keeps it until the next frame.
        discovery: with the frame, the weights before it, and where parts are thought to be.
        size: `WHOLE` or `HALF`.
        blend: of rotations.
    """
    weights, frame = problem.now.get(size, (None, None))
    if frame is None or weights is not discovery.weights:
        t = discovery.frame
        pictures = problem.sequence.frame(t)
        for other in (HALF, WHOLE):
            smaller = part_of(pictures, (), other)
            if other == HALF:
                problem.past[t] = _on_host(smaller)
            place = discovery.canonical, discovery.weights, discovery.predicted
            seen = where_parts_are(smaller, *place, TILE // other, blend=blend)
            problem.now[other] = discovery.weights, seen
        frame = problem.now[size][1]
    return frame


def picture_then(
    problem: Problem, discovery: Discovery, t: int, camera: int, blend: Blend
) -> tuple[Frame, HandlePose]:
    """What one camera saw in a frame of the past, at half the size, and where handles were.

    Args:
        problem: keeps the pictures.
        discovery: with poses, and the weights that say which pixels count.
        t: the frame.
        camera: its index.
        blend: of rotations.
    """
    if t not in problem.past:
        problem.past[t] = _on_host(part_of(problem.sequence.frame(t), (), HALF))
    frame = one_camera(problem.past[t], camera)
    frame = eqx.tree_at(lambda f: f.images, frame, jnp.asarray(frame.images, jnp.float32) / 255)
    pose = discovery.pose(t)
    seen = where_parts_are(frame, discovery.canonical, discovery.weights, pose, TILE // HALF, blend=blend)
    return seen, pose


def whole_picture(problem: Problem, t: int, camera: int) -> Frame:
    """What one camera saw in frame t, of which all pixels count that the data does not exclude."""
    if t not in problem.whole:
        problem.whole.clear()
        problem.whole[t] = problem.sequence.frame(t)
    frame = one_camera(problem.whole[t], camera)
    return Frame(frame.images, frame.depths, frame.cameras, counted(frame), frame.time)


@partial(jax.jit, static_argnames=("tile", "blend"))
def where_parts_are(
    frame: Frame,
    canonical: Canonical,
    weights: Float[Array, "M P"],
    pose: HandlePose,
    tile: int = TILE,
    *,
    blend: Blend,
) -> Frame:
    """The frame in which pixels count where what moves is, and where it was in the canonical scene.

    Args:
        frame: what cameras saw.
        canonical: the scene.
        weights: of its movable Gaussians.
        pose: where handles are.
        tile: pixels a side of what counts together.
        blend: of rotations.
    """
    moves = weights[:, BACKGROUND] < 0.5
    moved = skin(canonical.movable, weights, canonical.centers, pose, blend).means
    # What stands still is put behind all cameras' backs, where it touches nothing.
    nowhere = jnp.full_like(moved, jnp.nan)
    places = [jnp.where(moves[:, None], means, nowhere) for means in (moved, canonical.movable.means)]
    counts = tiles_to_pixels(touched_tiles(places, frame, tile), frame, tile)
    if frame.masks is not None:
        counts &= frame.masks
    return Frame(frame.images, frame.depths, frame.cameras, counts, frame.time)


def _on_host(frame: Frame) -> Frame:
    images = np.round(255 * np.asarray(frame.images)).astype(np.uint8)
    rest = jax.tree.map(np.asarray, frame)
    return eqx.tree_at(lambda f: f.images, rest, images)
