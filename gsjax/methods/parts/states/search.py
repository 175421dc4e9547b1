"""Search for the motions that together explain the points that have disappeared from where they were. Motions
are guessed from pieces of the surface, and judged by all of it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsjax.methods.parts.states.labels import connections, costs_of, labels_of
from gsjax.methods.parts.states.registration import (
    SAME_WAY,
    Target,
    axes_of,
    guesses,
    likeness,
    matched,
    moved,
    registered,
    rotated_normals,
)
from gsjax.methods.parts.states.surfaces import Evidence, Surface, denoised, evidence, pixel_width, surface_of
from gsjax.scene.frame import Frame

_SPACING = 1.5  # pixels between the points of a surface
_TOLERANCE = 2.0  # pixels by which depth may be off
_REACH = 8.0  # pixels within which registration finds a motion
_LEAST_THROUGH = 2, 1 / 3  # cameras, and their share, that must see through a point that is gone
_SMOOTH = 9  # neighbouring points that are judged together
_MOST_PIECES, _LEAST_PIECE = 40, 30  # most pieces, and fewest points of a piece
_BENDS = np.cos(np.radians(25))  # between normals of neighbours in one piece, at least
_FEW, _MANY = 120, 6000  # points by which a guess is judged: of its piece, and of all that is gone
_BEST, _SOME = 30, 1000  # guesses of a piece that are refined, and by how many points at most
_COLOR = 0.15  # largest difference of colours that match
_BLOCKED = 0.3  # share of the cameras that may see through the place to which a point moves
_EXPLAINS = 0.02  # share of what is gone that a motion must explain, at least
_FRESH = 0.25  # share of what a motion explains that must be new, or it repeats those before it
_HIDDEN = 0.3  # value of explaining a point that an earlier motion may have moved out of sight
_ALONGSIDE = 10.0  # pixels from the points that a motion explains within which it may hide others
_LENGTH_COST = 0.6  # share of its gain that a motion loses if it is as long as the scene is large
_MOST_MOTIONS = 30
_RIVALS, _RIVAL = 3, 0.5  # motions among which the best is chosen, and their least gain, relative to it
_BESIDE = -8, -4, 4, 8  # offsets, pixels, from which a motion better than the present one is sought ...
_TIMES_BESIDE = 3  # ... and how many times
_ROUNDS = 2  # alternations between labels and motions
_NEEDED, _LEAST_PART = 0.15, 100  # how much worse, and how many, points must fit without a motion


class States(NamedTuple):
    """What moves between two states.

    Attributes:
        surface: points of the first state.
        labels: the motion of each point, 0 for none.
        motions: from the first state to the second; the first is the identity.
    """

    surface: Surface
    labels: Int[np.ndarray, "n"]
    motions: Float[np.ndarray, "k 4 4"]


def states_of(before: Frame, after: Frame, seed: int = 0) -> States:
    """The parts that move rigidly from one state to another, and their motions: along an axis or about one,
    unless the cameras tell otherwise.

    Args:
        before, after: all cameras of a state, with depth, 0 where unknown.
        seed: random seed of the points by which guesses are judged.

    Raises:
        ValueError: a state has no depth, nothing has moved, or no motion is found that explains it.
    """
    if not all((np.asarray(frame.depths) > 0).any() for frame in (before, after)):
        raise ValueError("frames: expected depth in both states, found none that is known")
    before, after = denoised(before), denoised(after)
    pixel, random = pixel_width(before), np.random.default_rng(seed)
    first, second = (surface_of(frame, _SPACING * pixel) for frame in (before, after))
    gone, come = _seen_through(first, after, pixel), _seen_through(second, before, pixel)
    if gone.sum() < _LEAST_PIECE or come.sum() < _LEAST_PIECE:
        raise ValueError(
            f"frames: expected parts that moved between two states, found {gone.sum()} points gone and "
            f"{come.sum()} come of {len(gone)}; is the depth there, and in the unit of the poses?"
        )
    ends = np.concatenate([first.points[gone], second.points[come]])
    low, high = ends.min(0) - _REACH * pixel, ends.max(0) + _REACH * pixel
    size = float(np.max(high - low))
    anywhere, new = Target(second, pixel, low, high), Target(second.of(come), pixel, low, high)
    lost = first.of(gone)
    some = lost.of(random.permutation(len(lost.points))[:_MANY])
    candidates = _candidates(lost, anywhere, new, size, pixel, random)
    motions = _chosen_greedily(candidates, some, anywhere, new, after, size, pixel)
    if not motions:
        raise ValueError(
            "frames: expected parts that moved rigidly between two states, found no motion that explains "
            f"{_EXPLAINS:.0%} of what is gone"
        )
    here = np.flatnonzero(((first.points > low) & (first.points < high)).all(-1))  # nothing moves elsewhere
    few, motions = _labelled(first.of(here), motions, anywhere, after, pixel)
    labels = np.zeros(len(first.points), int)
    labels[here] = few
    return States(first, labels, motions)


def _seen_through(surface: Surface, other: Frame, pixel: float) -> Bool[np.ndarray, "n"]:
    """The points of one state that are gone in the other: its cameras see through them."""
    seen = evidence(surface.points, None, other, _TOLERANCE * pixel)
    away = (seen.through >= _LEAST_THROUGH[0]) & (seen.share > _LEAST_THROUGH[1])
    near = cKDTree(surface.points).query(surface.points, k=min(_SMOOTH, len(away)))[1]
    return away[near.reshape(len(away), -1)].mean(1) > 0.5


def _pieces(surface: Surface, radius: float) -> list[Int[np.ndarray, "m"]]:
    """Rows of the smooth pieces of a surface, the largest first."""
    pairs = cKDTree(surface.points).query_pairs(radius, output_type="ndarray")
    smooth = (surface.normals[pairs[:, 0]] * surface.normals[pairs[:, 1]]).sum(-1) > _BENDS
    pairs, count = pairs[smooth], len(surface.points)
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    total, piece_of = connected_components(links, directed=False)
    sizes = np.bincount(piece_of, minlength=total)
    largest = np.argsort(-sizes, kind="stable")[:_MOST_PIECES]
    return [np.flatnonzero(piece_of == i) for i in largest if sizes[i] >= _LEAST_PIECE]


def _candidates(
    lost: Surface,
    anywhere: Target,
    new: Target,
    size: float,
    pixel: float,
    random: np.random.Generator,
) -> list[Float[np.ndarray, "4 4"]]:
    """Motions that bring a piece of what is gone onto what is new in the other state."""
    common, found = axes_of(np.concatenate([lost.normals, new.surface.normals])), []
    for rows in _pieces(lost, 2.5 * pixel):
        piece = lost.of(rows)
        own = axes_of(piece.normals)
        same = (np.abs(own @ common.T).max(1) > np.cos(np.radians(5))).all()
        tried = np.concatenate(
            [guesses(piece.points, axes, size) for axes in ([common] if same else [common, own])]
        )
        mixed = random.permutation(len(rows))
        few, part = piece.of(mixed[:_FEW]), piece.of(mixed[:_SOME])
        match = matched(tried, few, new, _REACH * pixel)
        alike = (match.cosines > SAME_WAY) & (match.color_distance < _COLOR)
        costs = np.where(alike, np.minimum(match.far / (_REACH * pixel), 1), 1).mean(-1)
        places = moved(tried, few.points[:: len(few.points) // 8 + 1])
        for guess in tried[_distinct_best(costs, places, _REACH * pixel)]:
            found.append(registered(guess, part, anywhere, _REACH * pixel, _TOLERANCE * pixel))
    return found


def _distinct_best(
    costs: Float[np.ndarray, "k"], places: Float[np.ndarray, "k n 3"], apart: float
) -> list[int]:
    """The guesses of least cost, without those that bring points close to where a better guess brings them.

    Args:
        costs: cost of each guess.
        places: where each brings the points, metres.
        apart: mean distance that counts as close, metres.
    """
    chosen: list[int] = []
    for k in np.argsort(costs, kind="stable").tolist():
        if all(np.linalg.norm(places[k] - places[other], axis=-1).mean() > apart for other in chosen):
            chosen.append(k)
            if len(chosen) == _BEST:
                break
    return chosen


def _chosen_greedily(
    candidates: list[Float[np.ndarray, "4 4"]],
    some: Surface,
    anywhere: Target,
    new: Target,
    after: Frame,
    size: float,
    pixel: float,
) -> list[Float[np.ndarray, "4 4"]]:
    """The motions that explain most of what is gone, chosen greedily: each is judged by points and places
    that those before it have not used, and of motions that explain as much, the shorter wins. Points that
    move out of sight count as explained in part."""

    def evidence_for(motion: Float[np.ndarray, "4 4"]) -> Evidence:
        return evidence(
            moved(motion, some.points), rotated_normals(motion, some.normals), after, _TOLERANCE * pixel
        )

    def explained(motion: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "n"]:
        fits = likeness(motion, some, anywhere, _SPACING * pixel, _COLOR)
        fits = np.maximum(fits, likeness(motion, some, new, _TOLERANCE * pixel, _COLOR))
        if fits.mean() < _EXPLAINS:
            return np.zeros_like(fits)
        return fits * (evidence_for(motion).share <= _BLOCKED)

    def worth(motion: Float[np.ndarray, "4 4"], mine: Bool[np.ndarray, "n"]) -> float:
        way = np.linalg.norm(moved(motion, some.points[mine]) - some.points[mine], axis=-1).mean()
        return 1 - _LENGTH_COST * min(way / size, 1)

    if not candidates:
        return []
    explains = np.array([explained(motion) for motion in candidates])
    candidates = [motion for motion, mine in zip(candidates, explains, strict=True) if mine.any()]
    explains = explains[explains.any(1)]
    places = [new.nearest(moved(motion, some.points))[1] for motion in candidates]
    ends = np.array([moved(motion, some.points[:: len(some.points) // 8 + 1]) for motion in candidates])
    worths = np.array([worth(motion, mine > 0) for motion, mine in zip(candidates, explains, strict=True)])
    known, hidden = np.zeros((2, len(some.points)), bool)
    used, motions = np.zeros(len(new.surface.points), bool), []
    while len(candidates) and len(motions) < _MOST_MOTIONS:
        left = ~known * np.where(hidden, _HIDDEN, 1)
        fresh = np.array([mine * left * ~used[at] for mine, at in zip(explains, places, strict=True)])
        gains = fresh.sum(1) * worths * (fresh.sum(1) > _FRESH * explains.sum(1))
        if gains.max() < _EXPLAINS * len(known):
            break

        def score(motion: Float[np.ndarray, "4 4"], left: Float[np.ndarray, "n"] = left) -> float:
            mine = explained(motion)
            return float((mine * left).sum()) * worth(motion, mine > 0) if mine.any() else 0.0

        best = [
            k for k in _distinct_best(-gains, ends, 4 * pixel)[:_RIVALS] if gains[k] > _RIVAL * gains.max()
        ]
        tried = [
            _polished(candidates[k], some.of((explains[k] > 0) & ~known), anywhere, score, pixel)
            for k in best
        ]
        winner, (highest, motion) = max(zip(best, tried, strict=True), key=lambda one: one[1][0])
        explains[winner] = 0
        if not highest:
            continue
        motions.append(motion)
        mine = explained(motion) > 0
        beside = cKDTree(some.points[mine]).query(some.points)[0] < _ALONGSIDE * pixel
        known, hidden = known | mine, hidden | (beside & ~evidence_for(motion).seen)
        there = cKDTree(moved(motion, some.points[mine]))
        used |= there.query(new.surface.points, distance_upper_bound=2 * _SPACING * pixel)[0] < np.inf
    return motions


def _polished(
    motion: Float[np.ndarray, "4 4"],
    part: Surface,
    target: Target,
    score: Callable[[Float[np.ndarray, "4 4"]], float],
    pixel: float,
) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """The best score and its motion, among the given one and those that registration finds from it and from
    offsets along the axes of the part: a plate whose edges are hidden may be off within its plane."""
    axes = axes_of(part.normals)
    steps = pixel * np.concatenate([np.zeros((1, 3)), *(way * axes for way in _BESIDE)])
    best, highest = motion, score(motion)
    for _ in range(_TIMES_BESIDE):
        tried = np.tile(best, (len(steps), 1, 1))
        tried[:, :3, 3] += rotated_normals(best, steps)
        found = [registered(one, part, target, 3 * pixel, _SPACING * pixel, 8) for one in tried]
        scores = [score(one) for one in found]
        if max(scores) <= highest * 1.01:
            break
        best, highest = found[int(np.argmax(scores))], max(scores)
    return highest, best


def _labelled(
    surface: Surface, motions: list[Float[np.ndarray, "4 4"]], target: Target, after: Frame, pixel: float
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "k 4 4"]]:
    """The label of each point, and each motion registered by all of its points, found in turn."""
    spacing = _SPACING * pixel
    links, every = connections(surface, spacing), [np.eye(4), *motions]
    for _ in range(_ROUNDS):
        costs = np.stack([costs_of(motion, surface, target, after, spacing) for motion in every], -1)
        kept = _needed(costs)
        labels = labels_of(costs[:, kept], links, surface, [every[k] for k in kept], spacing)
        every = [np.eye(4)] + [
            registered(every[k], surface.of(labels == i), target, 2 * pixel, pixel, 25)
            for i, k in enumerate(kept)
            if k
        ]
    return labels, np.stack(every)


def _needed(costs: Float[np.ndarray, "n k"]) -> list[int]:
    """The indices of the motions without which points would fit clearly worse; 0, no motion, is always among
    them. Of two equal motions one is dropped, and so is one that also flips a plate whose sides look alike.

    Args:
        costs: cost of each point after each motion.
    """
    kept = list(range(costs.shape[1]))
    while len(kept) > 1:
        best, following = np.sort(costs[:, kept], axis=1)[:, :2].T
        follows, lead = costs[:, kept].argmin(1), following - best
        counts = np.bincount(follows, minlength=len(kept))
        leads = np.bincount(follows, lead, len(kept)) / np.maximum(counts, 1)
        leads[counts < _LEAST_PART] = 0
        leads[0] = np.inf
        if leads.min() >= _NEEDED:
            break
        kept.pop(int(leads.argmin()))
    return kept
