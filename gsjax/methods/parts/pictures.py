"""The pictures that steps use: those of the current frame and of past frames, and in the refinement those of
all frames. They are loaded on demand, and cached on the host or on the device while they are needed."""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.parts.discovery import Discovery
from gsjax.methods.parts.exposure import corrected
from gsjax.methods.parts.sizes import COARSE, COARSE_TILE, FINE, coarse_factor
from gsjax.methods.parts.stream import Canonical, valid_pixels
from gsjax.methods.parts.trajectory import BACKGROUND
from gsjax.methods.protocols import SequenceLike
from gsjax.scene.frame import Frame, one_camera, part_of
from gsjax.scene.handles import Blend, HandlePose, skin
from gsjax.scene.region import tiles_to_pixels, touched_tiles

_CAMERAS = 4  # used in a row before another frame is loaded
_ROOM = 2**30  # bytes of stored frames


@dataclass(frozen=True)
class Problem:
    """A recording, with caches of its pictures that are filled on demand.

    Attributes:
        sequence: the recording of synchronised cameras.
        past: past frames at the coarse size, on the host, with uint8 colours.
        now: the current frame by size, with the weights by which its pixels were selected.
        whole: the newest frame at full size, corrected to the scene's colours, by its index.
        stored: full-size frames as in the data, on the host, with uint8 colours.
        at_once: whether the poses of all frames are known at the start.
    """

    sequence: SequenceLike
    past: dict[int, Frame] = field(default_factory=dict)
    now: dict[str, tuple[Array, Frame]] = field(default_factory=dict)
    whole: dict[int, Frame] = field(default_factory=dict)
    stored: dict[int, Frame] = field(default_factory=dict)
    at_once: bool = False

    @cached_property
    def coarse_factor(self) -> int:
        """The factor by which coarse pictures are smaller than those of the data."""
        height, width = self.sequence.image(0, 0).shape[:2]
        return coarse_factor(width, height)


class Draws(NamedTuple):
    """The random choices of a frame's steps.

    Attributes:
        cameras: the camera of each step.
        past: for each step, (frame, camera) of each picture of the past.
    """

    cameras: list[int]
    past: list[list[tuple[int, int]]]


@lru_cache(maxsize=8)
def draws_of(seed: int, t: int, cameras: int, past: tuple[int, ...], count: int, steps: int) -> Draws:
    """The cameras and pictures of the past for all steps of frame t. Cameras take turns in a random order,
    which is reshuffled after each round. The same arguments give the same draws.

    Args:
        seed: random seed of the discovery.
        t: index of the frame.
        cameras: number of cameras.
        past: frames to draw from.
        count: number of pictures of the past in each step.
        steps: number of steps of the frame.
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
    """(frame, camera) for each step of the refinement, with several cameras of a frame in a row. All pictures
    are used equally often.

    Args:
        seed: random seed of the discovery.
        frames: frames to draw from.
        cameras: number of cameras.
        steps: number of steps.
    """
    rng, order = np.random.default_rng((seed, 1)), []
    left: dict[int, list[int]] = {t: [] for t in frames}
    while len(order) < steps:
        for t in rng.permutation(np.array(frames)).tolist():
            if len(left[t]) < min(_CAMERAS, cameras):
                left[t] += rng.permutation(cameras).tolist()
            order += [(t, left[t].pop(0)) for _ in range(min(_CAMERAS, cameras))]
    return order[:steps]


def current_frame(problem: Problem, discovery: Discovery, size: str, blend: Blend) -> Frame:
    """The current frame of all cameras.

    Args:
        problem: caches it until the next frame.
        discovery: the frame, the weights before it, and the predicted poses.
        size: `FINE` or `COARSE`.
        blend: how rotations are blended.
    """
    weights, frame = problem.now.get(size, (None, None))
    if frame is None or weights is not discovery.weights:
        t, whole = discovery.frame, _whole(problem, discovery, discovery.frame)
        shrink = problem.coarse_factor
        for other, factor, tile in ((COARSE, shrink, COARSE_TILE), (FINE, shrink // 2, 2 * COARSE_TILE)):
            smaller = part_of(whole, (), factor)
            if other == COARSE:
                problem.past[t] = _on_host(smaller)
            place = discovery.canonical, discovery.weights, discovery.predicted
            seen = with_part_masks(smaller, *place, tile, blend=blend)
            problem.now[other] = discovery.weights, seen
        frame = problem.now[size][1]
    return frame


def past_picture(
    problem: Problem, discovery: Discovery, t: int, camera: int, blend: Blend
) -> tuple[Frame, HandlePose]:
    """The picture of one camera in a past frame, at the coarse size, and the poses of the handles.

    Args:
        problem: caches the pictures.
        discovery: the poses, and the weights by which pixels are selected.
        t: index of the frame.
        camera: index of the camera.
        blend: how rotations are blended.
    """
    frame = _in_floats(one_camera(_coarse_in_bytes(problem, discovery, t), camera))
    pose = discovery.pose(t)
    seen = with_part_masks(frame, discovery.canonical, discovery.weights, pose, blend=blend)
    return seen, pose


def coarse_frame(problem: Problem, discovery: Discovery, t: int) -> Frame:
    """All cameras of frame t at the coarse size, on the host, corrected to the scene's colours."""
    return _in_floats(_coarse_in_bytes(problem, discovery, t))


def stored_frame(problem: Problem, t: int) -> Frame:
    """All cameras of frame t as in the data, on the host, with uint8 colours. If there is no room for all
    frames, those loaded first and the newest are kept.

    Args:
        problem: caches the frames.
        t: index of the frame.
    """
    if t not in problem.stored:
        frame = _on_host(problem.sequence.frame(t))
        size = sum(array.nbytes for array in jax.tree.leaves(frame))
        if problem.stored and (len(problem.stored) + 1) * size > _ROOM:
            problem.stored.popitem()
        problem.stored[t] = frame
    return problem.stored[t]


def any_picture(problem: Problem, discovery: Discovery, t: int, camera: int, shrink: int) -> Frame:
    """The picture of one camera in a frame, with all pixels that the data does not mask out.

    Args:
        problem: caches the frames.
        discovery: the exposures.
        t: index of the frame.
        camera: index of the camera.
        shrink: the factor by which the picture is smaller than in the data.
    """
    frame = _in_floats(one_camera(stored_frame(problem, t), camera))
    frame = corrected(part_of(frame, (), shrink), discovery.exposures[camera : camera + 1])
    return Frame(frame.images, frame.depths, frame.cameras, valid_pixels(frame), frame.time)


@partial(jax.jit, static_argnames=("tile", "blend"))
def with_part_masks(
    frame: Frame,
    canonical: Canonical,
    weights: Float[Array, "M P"],
    pose: HandlePose,
    tile: int = COARSE_TILE,
    *,
    blend: Blend,
) -> Frame:
    """The frame, masked to the pixels around the parts, both at their poses and at their canonical positions.

    Args:
        frame: the pictures.
        canonical: the canonical scene.
        weights: weights of its movable Gaussians.
        pose: poses of the handles.
        tile: edge of the square blocks that make up the masks, pixels.
        blend: how rotations are blended.
    """
    moves = weights[:, BACKGROUND] < 0.5
    moved = skin(canonical.movable, weights, canonical.centers, pose, blend).means
    # NaN positions touch no tile.
    nowhere = jnp.full_like(moved, jnp.nan)
    places = [jnp.where(moves[:, None], means, nowhere) for means in (moved, canonical.movable.means)]
    counts = tiles_to_pixels(touched_tiles(places, frame, tile), frame, tile)
    if frame.masks is not None:
        counts &= frame.masks
    return Frame(frame.images, frame.depths, frame.cameras, counts, frame.time)


def _whole(problem: Problem, discovery: Discovery, t: int) -> Frame:
    """All cameras of frame t, corrected to the scene's colours."""
    if t not in problem.whole:
        problem.whole.clear()
        problem.whole[t] = corrected(_in_floats(stored_frame(problem, t)), discovery.exposures)
    return problem.whole[t]


def _coarse_in_bytes(problem: Problem, discovery: Discovery, t: int) -> Frame:
    if t not in problem.past:
        problem.past[t] = _on_host(part_of(_whole(problem, discovery, t), (), problem.coarse_factor))
    return problem.past[t]


def _in_floats(frame: Frame) -> Frame:
    return eqx.tree_at(lambda f: f.images, frame, frame.images / np.float32(255))


def _on_host(frame: Frame) -> Frame:
    images = np.round(255 * np.clip(np.asarray(frame.images), 0, 1)).astype(np.uint8)
    rest = jax.tree.map(np.asarray, frame)
    return eqx.tree_at(lambda f: f.images, rest, images)
