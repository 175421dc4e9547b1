"""The start of a discovery from two states: all poses are known, and the refinement comes next."""

import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray
from scipy.spatial import cKDTree

from gsjax.geometry.cameras import Camera, pixels_of
from gsjax.methods.parts.anchor import Anchor
from gsjax.methods.parts.config import PartsConfig
from gsjax.methods.parts.discover import Start, start_from
from gsjax.methods.parts.exposure import AS_GIVEN
from gsjax.methods.parts.states.search import States, states_of
from gsjax.methods.protocols import SequenceLike
from gsjax.scene.gaussians import Gaussians

_NEAR = 3.0  # spacings of the surface within which a Gaussian takes its label
_VOTES = 5  # points that decide on the label of a Gaussian


def begin_with_states(
    sequence: SequenceLike, gaussians: Gaussians, anchor: Anchor, config: PartsConfig, key: PRNGKeyArray
) -> Start:
    """The parts of a recording of two frames, and their motions from the anchor to the other.

    Args:
        sequence: two frames, with depth.
        gaussians: the scene at the anchor frame.
        anchor: the canonical frame.
        config: settings.
        key: random key for the initial values of the field.

    Raises:
        ValueError: nothing has moved, or no Gaussian lies where something has.
    """
    frame = sequence.frame(anchor.frame)
    states = states_of(frame, sequence.frame(1 - anchor.frame), config.seed)
    slots = config.discover.most_parts + 1
    states = _of_the_largest(states, slots)
    count = sequence.num_cameras
    return start_from(
        anchor,
        gaussians,
        _weights(states, np.asarray(gaussians.means), slots),
        frame.cameras,
        np.tile(AS_GIVEN, (count, 1, 1)),  # a camera stands elsewhere in each state
        _masks(states, frame.cameras, count),
        config,
        key,
        np.zeros(0, np.float32),
        np.concatenate([states.motions, np.tile(np.eye(4), (slots - len(states.motions), 1, 1))]),
    )


def _of_the_largest(states: States, slots: int) -> States:
    """The states with their parts ordered from the largest to the smallest, as many as there are slots."""
    sizes = np.bincount(states.labels, minlength=len(states.motions))
    order = [0, *(1 + np.argsort(-sizes[1:], kind="stable"))][:slots]
    renamed = np.zeros(len(sizes), int)
    renamed[order] = np.arange(len(order))
    return States(states.surface, renamed[states.labels], states.motions[order])


def _weights(states: States, means: Float[np.ndarray, "N 3"], slots: int) -> Float[np.ndarray, "N P"]:
    """One-hot weights of Gaussians, by the most frequent label of the points around each."""
    points = states.surface.points
    tree = cKDTree(points)
    spacing = np.median(tree.query(points[:: len(points) // 1000 + 1], k=2)[0][:, 1])
    far, near = tree.query(means, k=_VOTES, distance_upper_bound=_NEAR * spacing)
    labels = np.append(states.labels, 0)[near]  # index len(points): none is near
    votes = np.zeros((len(means), slots), np.float32)
    for label, known in zip(labels.T, np.isfinite(far).T, strict=True):
        votes[np.arange(len(means)), label] += known
    alone = ~np.isfinite(far).any(1)
    votes[alone, 0] = 1
    return np.eye(slots, dtype=np.float32)[votes.argmax(1)]


def _masks(states: States, cameras: Camera, count: int) -> Int[np.ndarray, "C H W"]:
    """The labels at the pixels that points project to, 0 elsewhere; occlusion is ignored."""
    masks = np.zeros((count, cameras.height, cameras.width), np.int32)
    moving = states.labels > 0
    points, labels = states.surface.points[moving], states.labels[moving]
    for mask, viewmat, K in zip(masks, np.asarray(cameras.viewmat), np.asarray(cameras.K), strict=True):
        at = pixels_of(points, viewmat, K, cameras.width, cameras.height)
        mask[at.rows[at.inside], at.columns[at.inside]] = labels[at.inside]
    return masks
