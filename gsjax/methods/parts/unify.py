"""Unify and split: parts that move alike become one, and one that moves as two is divided (MotionSplicer,
section 3.2).

Two parts are compared by where they would take the points of both, over all frames in which both were there:
a translation alone depends on the pivot. They are compared only if both have moved in these beyond what
tracking errs by: parts that stand where they stood at first move alike, and are not one for that.
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
        """Without earlier frames."""
        return Motions(self.rotations[frame:], self.offsets[frame:])


def motions_of(
    rotations: Float[np.ndarray, "T P 3 3"],
    translations: Float[np.ndarray, "T P 3"],
    centers: Float[np.ndarray, "P 3"],
) -> Motions:
    """The motions of handles that turn about their own places.

    Args:
        rotations: of P handles in T frames.
        translations: of the same, metres.
        centers: about which they turn, metres.
    """
    return Motions(rotations, centers + translations - np.einsum("tpij,pj->tpi", rotations, centers))


def gap(motions: Motions, a: int, b: int, points: Float[np.ndarray, "n 3"]) -> float:
    """How far two parts' motions take the same points apart, root mean square over frames, metres.

    Args:
        motions: of all parts.
        a, b: the two.
        points: canonical, metres.
    """
    turn = motions.rotations[:, a] - motions.rotations[:, b]
    shift = motions.offsets[:, a] - motions.offsets[:, b]
    apart = np.einsum("tij,nj->tni", turn, points) + shift[:, None]
    return float(np.sqrt(np.mean(np.sum(apart**2, axis=-1))))


def extent(motions: Motions, part: int, points: Float[np.ndarray, "n 3"]) -> float:
    """How far a part has moved from where it was in the canonical scene, at most over frames, metres; 0
    without frames.

    Args:
        motions: of all parts.
        part: which.
        points: its own, canonical, metres.
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
    """For each part the one that it is joined to: itself, or the largest of those that it moves like.

    Pairs are joined from the most alike on; whoever joins takes the larger one's motion, so that chains of
    small differences do not grow.

    Args:
        motions: of all parts, over the frames seen so far.
        points: canonical, metres.
        labels: the part of each point.
        alive: which parts there are; the background's never joins here.
        since: from which of the frames on a part's motion is its own: before, it was part of another.
        noise_m: error of tracking, metres: what moved less is not compared, a smaller gap is none.
        tolerance: gap that is none, as a share of the lesser of the two motions.
    """
    into = np.arange(len(alive))
    sizes = np.bincount(labels, minlength=len(alive))
    mine = {int(p): points[labels == p] for p in np.flatnonzero(alive & (sizes > 0)) if p != BACKGROUND}

    def apart(p: int, q: int) -> float:
        """The gap between two parts, in what counts as none."""
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
    """Where a part would be divided.

    Attributes:
        beyond: which of its points lie beyond the cut.
        score: how far the two sides' pulls differ, in what chance would make of them; above some 6 it is no
            chance.
    """

    beyond: Bool[np.ndarray, "n"]
    score: float


def best_cut(points: Float[np.ndarray, "n 3"], pulls: Float[np.ndarray, "n 3"]) -> Cut:
    """The plane across one of a part's principal axes on whose sides pictures pull most differently.

    Of a part that moves as one, the pulls that are left at frames' ends are noise; of one that moves as two,
    they are of one mind on each side. Strong pulls count little more than typical ones, for at edges chance
    pulls strongly too. Points that feel no pull, because nothing shows of them, do not count.

    Args:
        points: of the part, canonical, metres.
        pulls: as in `StreamState`.
    """
    felt = np.linalg.norm(pulls, axis=1) > 0
    if felt.sum() < 2 * _LEAST_SIDE:
        return Cut(np.zeros(len(points), bool), 0.0)
    middle = points[felt].mean(0)
    axes = np.linalg.svd(points[felt] - middle, full_matrices=False)[2]
    strengths = np.linalg.norm(pulls[felt], axis=1, keepdims=True)
    minds = pulls[felt] / (strengths + np.median(strengths))
    off = minds - minds.mean(0)
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
