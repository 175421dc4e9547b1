"""Which motion each point of a surface follows, by the evidence of the other state's cameras. Where there is
none, it spreads from other points along the surface (random walks, Grady 2006)."""

from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from gsjax.methods.parts.states.registration import Target, matched, moved, rotated_normals
from gsjax.methods.parts.states.surfaces import Surface, color_distance, evidence
from gsjax.scene.frame import Frame

_NEIGHBORS = 10
_COLOR = 0.05  # difference of colours at which neighbours are hardly connected
_BEND = 0.1  # strength of the connection of neighbours with perpendicular normals
_SAME_WAY, _SAME_COLOR = 0.7, 0.15
_UNKNOWN = 0.4  # cost of a point about which nothing is known; 0 for one that agrees, up to 1 for others
_MOVES = 0.1  # cost of following a motion, unless nothing is known about the point
_THERE = 0.3  # cost of a point where cameras see something, but no surface that agrees
_TEMPERATURE = 0.1  # difference of costs that changes odds by a factor of e
_PULL = 0.5  # weight of the cameras' evidence, relative to a connection
_ITERATIONS = 300
_APART = 0.5  # spacings by which the two sides of a thin plate are kept apart
_ROUNDS = 3  # alternations between labels and which points take the places


def connections(surface: Surface, spacing: float) -> csr_array:
    """How strongly neighbouring points of a surface are connected, 0 to 1; symmetric.

    Args:
        surface: the points.
        spacing: distance between them, metres.
    """
    count = min(_NEIGHBORS + 1, len(surface.points))
    far, near = (a[:, 1:] for a in cKDTree(surface.points).query(surface.points, k=count))
    apart = color_distance(surface.colors[:, None], surface.colors[near])
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
        surface: the surface before it.
        target: the surface of the other state.
        frame: all cameras of the other state.
        spacing: distance between the points, metres.
    """
    found = evidence(
        moved(motion, surface.points), rotated_normals(motion, surface.normals), frame, 4 / 3 * spacing
    )
    match = matched(motion, surface, target, spacing)
    fits = (match.far < spacing) & (match.cosines > _SAME_WAY)
    off = np.maximum(match.color_distance / _SAME_COLOR, (match.off / spacing) ** 2)
    unsure = np.where(found.there > 0, _THERE, _UNKNOWN)
    cost = np.where(fits, 0.5 * _UNKNOWN * np.minimum(off, 1), unsure)
    return np.where(found.seen, cost + (1 - _UNKNOWN) * np.minimum(3 * found.share, 1), _UNKNOWN)


def labels_of(
    costs: Float[np.ndarray, "n k"],
    links: csr_array,
    surface: Surface,
    motions: list[Float[np.ndarray, "4 4"]],
    spacing: float,
) -> Int[np.ndarray, "n"]:
    """The motion of each point, as an index.

    A point gains nothing from a place that another point takes by another motion. Otherwise, the part of a
    wall that a sliding drawer comes to hide would fit as if it had slid too, onto a part of the wall that is
    seen to stay. Which point takes a place depends on the labels, so both are found in turn.

    Args:
        costs: from `costs_of`, for each motion.
        links: from `connections`.
        surface: the surface before the motions.
        motions: all of them; the first is the identity.
        spacing: distance between the points, metres.
    """
    claims = _claims(costs, surface, motions, spacing)
    costs = costs + np.clip(_UNKNOWN - costs, 0, [0, *[_MOVES] * (len(motions) - 1)])
    worth = np.maximum(_UNKNOWN - costs, 0)
    shares = _diffused(costs, links)
    for _ in range(_ROUNDS):
        taken = np.zeros(costs.shape)
        for k, j, rows, others in claims:
            taken[rows, k] = np.maximum(taken[rows, k], shares[others, j])
        likely = np.clip(2 * taken, 0, 1)  # certain, from a share of one half on
        shares = _diffused(costs + worth * likely, links)
    return shares.argmax(-1)


def _claims(
    costs: Float[np.ndarray, "n k"],
    surface: Surface,
    motions: list[Float[np.ndarray, "4 4"]],
    spacing: float,
) -> list[tuple[int, int, Int[np.ndarray, "m"], Int[np.ndarray, "m"]]]:
    """The points that two motions bring to the same place, for each pair: the motions, the points of the
    first, and those of the second. Arguments as for `labels_of`."""
    ways = [rotated_normals(motion, surface.normals) for motion in motions]
    places = [
        moved(motion, surface.points) + _APART * spacing * way
        for motion, way in zip(motions, ways, strict=True)
    ]
    fits, trees, claims = costs < _UNKNOWN, [cKDTree(place) for place in places], []
    for k, j in permutations(range(len(motions)), 2):
        rows = np.flatnonzero(fits[:, k])
        far, others = trees[j].query(places[k][rows], distance_upper_bound=spacing)
        rows, others = rows[far < np.inf], others[far < np.inf]
        both = ((ways[k][rows] * ways[j][others]).sum(-1) > _SAME_WAY) & fits[others, j]
        claims.append((k, j, rows[both], others[both]))
    return claims


def _diffused(costs: Float[np.ndarray, "n k"], links: csr_array) -> Float[np.ndarray, "n k"]:
    """How likely each point follows each motion; where the costs do not tell, as likely as its neighbours."""
    likely = np.exp(-(costs - costs.min(1, keepdims=True)) / _TEMPERATURE)
    likely /= likely.sum(1, keepdims=True)
    pull = _PULL * (likely.max(1) - 1 / costs.shape[1]) + 1e-4
    diagonal = links.sum(1) + pull
    system = diags_array(diagonal) - links
    scaled = LinearOperator(system.shape, lambda x: x / diagonal)
    solved = [
        cg(system, pull * share, x0=share, rtol=1e-4, maxiter=_ITERATIONS, M=scaled)[0] for share in likely.T
    ]
    return np.stack(solved, -1)
