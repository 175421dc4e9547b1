"""Which motion each point of a surface follows: what the cameras of the other state say of it, spread over
the surface where they say nothing (random walks, Grady 2006)."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from gsjax.methods.parts.states.registration import Target, matched, moved, turned
from gsjax.methods.parts.states.surfaces import Surface, evidence, unlike
from gsjax.scene.frame import Frame

_NEIGHBORS = 10
_COLOR = 0.05  # difference of colours at which neighbours are hardly connected
_BEND = 0.1  # strength of the connection of neighbours with perpendicular normals
_SAME_WAY, _SAME_COLOR = 0.7, 0.15
_UNKNOWN = 0.4  # cost of a point of which nothing is known; of one that agrees it is 0, of others up to 1
_SHARPNESS = 0.05  # differences of costs that count
_PULL = 0.5  # of the cameras, relative to a connection
_ITERATIONS = 300


def connections(surface: Surface, spacing: float) -> csr_array:
    """How strongly neighbouring points of a surface are connected, 0 to 1: symmetric.

    Args:
        surface: the points.
        spacing: between them, metres.
    """
    count = min(_NEIGHBORS + 1, len(surface.points))
    far, near = (a[:, 1:] for a in cKDTree(surface.points).query(surface.points, k=count))
    apart = unlike(surface.colors[:, None], surface.colors[near])
    bend = np.clip((surface.normals[:, None] * surface.normals[near]).sum(-1), 0, 1)
    strengths = np.exp(-apart / _COLOR - 0.5 * (far / (1.5 * spacing)) ** 2) * (_BEND + (1 - _BEND) * bend)
    rows = np.repeat(np.arange(len(far)), far.shape[1])
    links = csr_array((strengths.ravel(), (rows, near.ravel())), shape=(len(far), len(far)))
    return (links + links.T) / 2


def costs_of(
    motion: Float[np.ndarray, "4 4"], surface: Surface, target: Target, frame: Frame, spacing: float
) -> Float[np.ndarray, "n"]:
    """How badly each point of a surface would fit the other state after a motion, 0 to 1.

    Args:
        motion: the motion.
        surface: before it.
        target: the surface of the other state.
        frame: all cameras of the other state.
        spacing: between the points, metres.
    """
    said = evidence(moved(motion, surface.points), turned(motion, surface.normals), frame, 4 / 3 * spacing)
    match = matched(motion, surface, target, spacing)
    fits = (match.far < spacing) & (match.cosines > _SAME_WAY)
    off = match.unlike / _SAME_COLOR
    cost = np.where(fits, 0.5 * _UNKNOWN * np.minimum(off, 1), _UNKNOWN)
    return np.where(said.seen, cost + (1 - _UNKNOWN) * np.minimum(3 * said.share, 1), _UNKNOWN)


def labels_of(costs: Float[np.ndarray, "n k"], links: csr_array) -> Int[np.ndarray, "n"]:
    """The motion of each point, as an index.

    Args:
        costs: from `costs_of`, for each motion.
        links: from `connections`.
    """
    likely = np.exp(-(costs - costs.min(1, keepdims=True)) / _SHARPNESS)
    likely /= likely.sum(1, keepdims=True)
    pull = _PULL * (likely.max(1) - 1 / costs.shape[1]) + 1e-4
    diagonal = links.sum(1) + pull
    system = diags_array(diagonal) - links
    scaled = LinearOperator(system.shape, lambda x: x / diagonal)
    spread = [
        cg(system, pull * share, x0=share, rtol=1e-4, maxiter=_ITERATIONS, M=scaled)[0] for share in likely.T
    ]
    return np.stack(spread, -1).argmax(-1)
