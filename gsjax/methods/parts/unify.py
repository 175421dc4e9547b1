"""Unify and split: parts that move alike are joined, and a part that moves as two is divided (MotionSplicer,
section 3.2).

Two parts are compared by the positions to which they would take the points of both, over all frames in which
both existed; translations alone would depend on the pivot. They are compared only if both have moved by more
than the tracking error in these frames: parts that have not moved yet move alike, but need not be one.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from gsjax.methods.parts.trajectory import BACKGROUND

_LEAST_SIDE = 5  # Gaussians on each side of a cut


class Motions(NamedTuple):
    """Rigid motions of the canonical scene's points, x -> R x + offset.

    Attributes:
        rotations: [T, P, 3, 3].
        offsets: metres, [T, P, 3].
    """

    rotations: Float[np.ndarray, "T P 3 3"]
    offsets: Float[np.ndarray, "T P 3"]

    def since(self, frame: int) -> "Motions":
        """The motions without earlier frames."""
        return Motions(self.rotations[frame:], self.offsets[frame:])


def scene_motions(
    rotations: Float[np.ndarray, "T P 3 3"],
    translations: Float[np.ndarray, "T P 3"],
    centers: Float[np.ndarray, "P 3"],
) -> Motions:
    """The motions of handles that rotate about their own centres.

    Args:
        rotations: rotations of P handles in T frames.
        translations: their translations, metres.
        centers: centres of rotation, metres.
    """
    return Motions(rotations, centers + translations - np.einsum("tpij,pj->tpi", rotations, centers))


def gap(motions: Motions, a: int, b: int, points: Float[np.ndarray, "n 3"]) -> float:
    """The distance between the same points moved by two parts, root mean square over points and frames,
    metres.

    Args:
        motions: motions of all parts.
        a, b: indices of the two parts.
        points: canonical points, metres.
    """
    turn = motions.rotations[:, a] - motions.rotations[:, b]
    shift = motions.offsets[:, a] - motions.offsets[:, b]
    apart = np.einsum("tij,nj->tni", turn, points) + shift[:, None]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))))


def extent(motions: Motions, part: int, points: Float[np.ndarray, "n 3"]) -> float:
    """The largest displacement of a part from its canonical place over frames, root mean square over points,
    metres; 0 without frames.

    Args:
        motions: motions of all parts.
        part: index of the part.
        points: canonical points of the part, metres.
    """
    turn = motions.rotations[:, part] - np.eye(3)
    moved = np.einsum("tij,nj->tni", turn, points) + motions.offsets[:, part][:, None]
    return float(np.sqrt(np.sum(moved**2, axis=-1).mean(-1).max(initial=0.0)))


def unified(
    motions: Motions,
    points: Float[np.ndarray, "M 3"],
    labels: Int[np.ndarray, "M"],
    alive: Bool[np.ndarray, "P"],
    since: Int[np.ndarray, "P"],
    *,
    noise_m: float,
    tolerance: float,
) -> Int[np.ndarray, "P"]:
    """The part that each part is joined to: itself, or the largest of those that move alike.

    Pairs are joined in order of similarity; the smaller part takes the motion of the larger one, so that
    small differences do not add up along chains.

    Args:
        motions: motions of all parts, over the frames found so far.
        points: canonical points, metres.
        labels: the part of each point.
        alive: the slots that hold a part; the background is never joined here.
        since: the frame from which each part's motion is its own; before, it belonged to another part.
        noise_m: tracking error, metres: parts that moved less are not compared, and smaller gaps do not
            count.
        tolerance: largest gap between parts that move alike, as a share of the smaller of both motions.
    """
    into = np.arange(len(alive))
    sizes = np.bincount(labels, minlength=len(alive))
    mine = {int(p): points[labels == p] for p in np.flatnonzero(alive & (sizes > 0)) if p != BACKGROUND}

    def apart(p: int, q: int) -> float:
        """The gap between two parts, as a fraction of the largest gap of parts that move alike."""
        own = motions.since(int(max(since[p], since[q])))
        moved = min(extent(own, part, mine[part]) for part in (p, q))
        if moved <= noise_m:
            return np.inf
        allowed = max(noise_m, tolerance * moved)
        return gap(own, p, q, np.concatenate([mine[p], mine[q]])) / allowed

    moving = [p for p in mine if extent(motions, p, mine[p]) > noise_m]
    gaps = {pair: apart(*pair) for pair in combinations(moving, 2)}
    while gaps and min(gaps.values()) < 1:
        keep, lose = sorted(min(gaps, key=gaps.__getitem__), key=lambda p: -len(mine[p]))
        into[into == lose] = keep
        mine[keep] = np.concatenate([mine[keep], mine.pop(lose)])
        moving.remove(lose)
        gaps = {pair: far for pair, far in gaps.items() if keep not in pair and lose not in pair}
        gaps |= {(keep, p): apart(keep, p) for p in moving if p != keep}
    return into


class Cut(NamedTuple):
    """A division of a part by a plane.

    Attributes:
        beyond: the points of the part that lie beyond the cut.
        score: difference between the two sides' pulls, relative to the difference expected by chance;
            significant above about 6.
    """

    beyond: Bool[np.ndarray, "n"]
    score: float


def best_cut(points: Float[np.ndarray, "n 3"], pulls: Float[np.ndarray, "n 3"]) -> Cut:
    """The plane perpendicular to a principal axis of a part whose two sides the pictures pull apart the most.

    In a part that moves as one, the pulls that remain at the end of a frame are noise; in one that moves as
    two, they agree on each side. Strong pulls count little more than typical ones, because noise is strong at
    edges. Points without a pull, which are not visible, do not count.

    Args:
        points: canonical points of the part, metres.
        pulls: as in `StreamState`.
    """
    felt = np.linalg.norm(pulls, axis=1) > 0
    if felt.sum() < 2 * _LEAST_SIDE:
        return Cut(np.zeros(len(points), bool), 0.0)
    middle = points[felt].mean(0)
    axes = np.linalg.svd(points[felt] - middle, full_matrices=False)[2]
    strengths = np.linalg.norm(pulls[felt], axis=1, keepdims=True)
    damped = pulls[felt] / (strengths + np.median(strengths))
    off = damped - damped.mean(0)
    typical = np.sqrt(np.mean(np.sum(off**2, axis=1)))
    best = Cut(np.zeros(len(points), bool), 0.0)
    for axis in axes:
        along = (points - middle) @ axis
        order = np.argsort(along[felt], kind="stable")
        sums = np.linalg.norm(np.cumsum(off[order], axis=0), axis=1)[:-1]
        count = np.arange(1, len(order))
        scores = sums / np.sqrt(count * (len(order) - count) / len(order)) / max(typical, 1e-30)
        scores[: _LEAST_SIDE - 1] = scores[len(scores) - _LEAST_SIDE + 1 :] = 0
        at = int(scores.argmax())
        if scores[at] > best.score:
            edge = along[felt][order[at : at + 2]].mean()
            best = Cut(along > edge, float(scores[at]))
    return best
