"""Registration of two surfaces by rigid motions: initial guesses of the motions that joints allow, and the
motion that fits best near a guess (point to plane, Chen and Medioni 1992)."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from gsjax.methods.parts.states.surfaces import Surface, color_distance

_MOST_CELLS = 4e6  # of the grid that finds nearest points
_BORDER = 4  # cells around it
_ALIKE = np.cos(np.radians(8)), np.cos(np.radians(25))  # of normals of one direction (least), of two (most)
_FEWEST = 0.02  # share of the normals that a direction needs
_SLIDES = np.arange(0.04, 0.75, 0.03)  # in sizes of the scene
_TURNS = np.radians(np.arange(8, 180, 8))
SAME_WAY = 0.6
"""Least cosine between normals of points that may correspond."""
_CLOSER = 0.75  # factor on the reach from round to round
_SLIDE_WEIGHT = 0.01  # weight of the penalty on sliding along the rotation axis, relative to the points ...
_SLIDE_LIMIT = 0.3  # ... and the slide beyond which it residuals no harder, in reaches
_LEAST_TURN = 0.05  # radians; a motion that rotates by less counts as a translation
_DARK, _LIT = 0.02, np.log(2.5)  # brightness that is not informative; largest log change of the lighting
_CONTRAST = 0.1  # difference in brightness that counts as much as the reach
_SOFT_WEIGHT = 0.4  # weight of edges and colours, relative to that of planes, which are measured better
_LEAST_MATCHES = 8  # fewest points from which the lighting of a side is estimated


class Target:
    """Finds the nearest point of a surface, to within a cell of a grid.

    Args:
        surface: the surface.
        cell: edge of the cells, metres; larger where there would be too many.
        low, high: corners of the box that matters, metres.
    """

    def __init__(
        self, surface: Surface, cell: float, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
    ):
        cell = max(cell, float(np.prod(high - low) / _MOST_CELLS) ** (1 / 3))
        self.surface, self._cell, self._low = surface, cell, low - _BORDER * cell
        self._box = low, high
        shape = np.ceil((high - low) / cell).astype(int) + 2 * _BORDER
        rows = np.full(shape, -1, np.int32)
        places = ((surface.points - self._low) / cell).astype(int)
        inside = ((places >= 0) & (places < shape)).all(-1)
        rows[tuple(places[inside].T)] = np.flatnonzero(inside)
        at = distance_transform_edt(rows < 0, return_distances=False, return_indices=True)
        self._rows = rows[tuple(at)]

    @cached_property
    def edges(self) -> "Target | None":
        """The edges of the surface; None if it has none."""
        ends = self.surface.outward.any(-1)
        return Target(self.surface.of(ends), self._cell, *self._box) if ends.any() else None

    def nearest(
        self, points: Float[np.ndarray, "*n 3"]
    ) -> tuple[Float[np.ndarray, "*n"], Int[np.ndarray, "*n"]]:
        """Distances to the nearest points of the surface, metres, and their rows."""
        places = ((points - self._low) / self._cell).astype(int)
        rows = self._rows[tuple(np.clip(places, 0, np.array(self._rows.shape) - 1).reshape(-1, 3).T)]
        rows = rows.reshape(points.shape[:-1])
        return np.linalg.norm(points - self.surface.points[rows], axis=-1), rows


def moved(
    motion: Float[np.ndarray, "*k 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "*k n 3"]:
    """Points moved by rigid motions."""
    return points @ np.swapaxes(motion[..., :3, :3], -1, -2) + motion[..., None, :3, 3]


def rotated_normals(
    motion: Float[np.ndarray, "*k 4 4"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "*k n 3"]:
    """Normals rotated by rigid motions."""
    return normals @ np.swapaxes(motion[..., :3, :3], -1, -2)


def axes_of(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Three perpendicular directions, the most frequent ones among the normals, as rows.

    Args:
        normals: of a surface.
    """
    some = normals[:: max(1, len(normals) // 2000)]
    alike = np.abs(some @ some.T)
    left, found = np.ones(len(some), bool), []
    for _ in range(2 if len(some) else 0):
        scores = ((alike > _ALIKE[0]) & left).sum(1) * left
        best = int(scores.argmax())
        if scores[best] < _FEWEST * len(some):
            break
        mine = (alike[best] > _ALIKE[0]) & left
        direction = (some[mine] * np.sign(some[mine] @ some[best])[:, None]).mean(0)
        for other in found:
            direction = direction - (direction @ other) * other
        found.append(direction / np.linalg.norm(direction))
        left &= np.abs(some @ found[-1]) < _ALIKE[1]
    for axis in np.eye(3)[np.argsort(np.abs(np.array(found or [[0, 0, 0]])).max(0))]:
        if len(found) < 2:
            axis = axis - sum(((axis @ other) * other for other in found), np.zeros(3))
            found.append(axis / np.linalg.norm(axis))
    return np.stack([*found, np.cross(*found)])


def guesses(
    points: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "3 3"], size: float
) -> Float[np.ndarray, "k 4 4"]:
    """Initial guesses: translations along axes, and rotations about lines parallel to them, through edges and
    the middle of the points' bounding box.

    Args:
        points: points of a part, metres.
        axes: three perpendicular directions.
        size: size of the scene, metres.
    """
    shifts = size * np.concatenate([-_SLIDES, _SLIDES])[:, None]
    slides = np.tile(np.eye(4), (3 * len(shifts), 1, 1))
    slides[:, :3, 3] = np.concatenate([shifts * axis for axis in axes])
    angles, motions = np.concatenate([-_TURNS, _TURNS]), [slides]
    for i, axis in enumerate(axes):
        across = np.delete(axes, i, 0)
        low, high = np.quantile(points @ across.T, (0.01, 0.99), axis=0)
        places = (
            np.stack(np.meshgrid(*np.stack([low, (low + high) / 2, high], -1)), -1).reshape(-1, 2) @ across
        )
        turns = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
        about = np.tile(np.eye(4), (len(places), len(turns), 1, 1))
        about[..., :3, :3] = turns
        about[..., :3, 3] = places[:, None] - np.einsum("kij,pj->pki", turns, places)
        motions.append(about.reshape(-1, 4, 4))
    return np.concatenate(motions)


def registered(
    motion: Float[np.ndarray, "4 4"],
    part: Surface,
    target: Target,
    reach: float,
    least: float,
    rounds: int = 10,
) -> Float[np.ndarray, "4 4"]:
    """The motion near a guess that registers a part with a surface. Where the surface leaves this open, it
    rotates without sliding along its axis.

    Args:
        motion: the guess.
        part: the part before the motion.
        target: the surface after it.
        reach: distance within which points are matched in the first round, metres.
        least: the same in the last rounds.
        rounds: number of rounds.
    """
    edges = part.of(part.outward.any(-1))
    for k in range(rounds):
        near = max(reach * _CLOSER**k, least)
        pairs = _pairs(motion, part, target, near)
        if pairs.counts.sum() < 6:
            return motion
        residuals = [_to_planes(pairs, target.surface), _to_brightness(pairs, part, target.surface, near)]
        if target.edges is not None:
            residuals.append(_to_edges(motion, edges, target.edges, near))
        at, along, gaps = (np.concatenate(values) for values in zip(*residuals, strict=True))
        middle = at.mean(0)
        weights = 1 / (1 + (gaps / (0.3 * near)) ** 2) ** 2
        slopes = np.concatenate([np.cross(at - middle, along), along], -1)
        curvature, slope = (slopes * weights[:, None]).T @ slopes, (slopes * weights[:, None]).T @ gaps
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        if (angle := np.linalg.norm(turn)) > _LEAST_TURN:
            axis = np.concatenate([np.zeros(3), turn / angle])
            slid = np.clip(motion[:3, 3] @ axis[3:], -_SLIDE_LIMIT * near, _SLIDE_LIMIT * near)
            curvature += _SLIDE_WEIGHT * len(at) * np.outer(axis, axis)
            slope -= _SLIDE_WEIGHT * len(at) * slid * axis
        damped = curvature + np.diag(1e-5 * np.diag(curvature) + 1e-9 * np.trace(curvature))
        step = np.linalg.solve(damped, slope)
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
        change[:3, 3] = middle + step[3:] - change[:3, :3] @ middle
        motion = change @ motion
    return motion


class _Residuals(NamedTuple):
    """Residuals at points, each along a direction: gaps in metres, or weighted to be comparable."""

    at: Float[np.ndarray, "m 3"]
    along: Float[np.ndarray, "m 3"]
    gaps: Float[np.ndarray, "m"]


class _Pairs(NamedTuple):
    """Points after a motion, the rows of the nearest surface points, and whether the two may correspond."""

    at: Float[np.ndarray, "n 3"]
    rows: Int[np.ndarray, "n"]
    counts: Bool[np.ndarray, "n"]


def _pairs(motion: Float[np.ndarray, "4 4"], part: Surface, target: Target, near: float) -> _Pairs:
    at = moved(motion, part.points)
    far, rows = target.nearest(at)
    same = (rotated_normals(motion, part.normals) * target.surface.normals[rows]).sum(-1) > SAME_WAY
    return _Pairs(at, rows, (far < near) & same)


def _to_planes(pairs: _Pairs, surface: Surface) -> _Residuals:
    """Residuals from points to the tangent planes of the surface."""
    at, rows, counts = pairs
    normals = surface.normals[rows]
    return _Residuals(at[counts], normals[counts], ((surface.points[rows] - at) * normals).sum(-1)[counts])


def _to_brightness(pairs: _Pairs, part: Surface, surface: Surface, near: float) -> _Residuals:
    """Residuals from points, along the surface, to where it is as bright as they are (Park et al. 2017)."""
    at, rows, counts = pairs
    scale, slope = _SOFT_WEIGHT * near / _CONTRAST, surface.slope[rows]
    bright = part.brightness * _relit(part, surface.brightness[rows], counts)
    gaps = bright - surface.brightness[rows] - (slope * (at - surface.points[rows])).sum(-1)
    return _Residuals(at[counts], scale * slope[counts], scale * gaps[counts])


def _to_edges(motion: Float[np.ndarray, "4 4"], edges: Surface, target: Target, near: float) -> _Residuals:
    """Residuals from the edges of a part, along the surface, to edges of the surface."""
    at, rows, counts = _pairs(motion, edges, target, near)
    outward = target.surface.outward[rows]
    counts &= (rotated_normals(motion, edges.outward) * outward).sum(-1) > SAME_WAY
    gaps = ((target.surface.points[rows] - at) * outward).sum(-1)
    return _Residuals(at[counts], _SOFT_WEIGHT * outward[counts], _SOFT_WEIGHT * gaps[counts])


class Match(NamedTuple):
    """How points after a motion match the surface that is there.

    Attributes:
        far: distances to the nearest points of the surface, metres.
        off: distances to their tangent planes, metres.
        cosines: cosines between both normals.
        color_distance: difference between their colours, 0 to 1.
    """

    far: Float[np.ndarray, "*k n"]
    off: Float[np.ndarray, "*k n"]
    cosines: Float[np.ndarray, "*k n"]
    color_distance: Float[np.ndarray, "*k n"]


def matched(motion: Float[np.ndarray, "*k 4 4"], part: Surface, target: Target, near: float) -> Match:
    """How the points of a part match a surface, after one motion or each of many. A part that rotates is lit
    differently, so colours are compared after making each of its sides as bright as what it matches.

    Args:
        motion: the motions.
        part: the part before them.
        target: the surface after them.
        near: distance within which points are used to estimate how a side is lit, metres.
    """
    at, surface = moved(motion, part.points), target.surface
    far, rows = target.nearest(at)
    off = np.abs(((surface.points[rows] - at) * surface.normals[rows]).sum(-1))
    cosines = (rotated_normals(motion, part.normals) * surface.normals[rows]).sum(-1)
    tells = (far < near) & (cosines > SAME_WAY)
    lit = _relit(part, surface.brightness[rows], tells)
    return Match(far, off, cosines, color_distance(part.colors * lit[..., None], surface.colors[rows]))


def _relit(
    part: Surface, brightness: Float[np.ndarray, "*k n"], tells: Bool[np.ndarray, "*k n"]
) -> Float[np.ndarray, "*k n"]:
    """The factor on the brightness of each point of a part, estimated from what the points of its side match.

    Args:
        part: the points.
        brightness: brightness of the surface point that each matches.
        tells: whether to use each match.
    """
    brighter = np.log((brightness + _DARK) / (part.brightness + _DARK))
    side, times = _side(part.normals), np.ones(brighter.shape)
    for k in np.unique(side):
        mine = side == k
        known = np.where(tells[..., mine], brighter[..., mine], np.nan)
        enough = tells[..., mine].sum(-1, keepdims=True) >= _LEAST_MATCHES
        middle = np.nanmedian(np.where(enough, known, 0), axis=-1, keepdims=True)
        times[..., mine] = np.exp(np.clip(middle, -_LIT, _LIT))
    return times


def _side(normals: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """The side of a part that each point is on, 0 to 5, by its normal."""
    largest = np.abs(normals).argmax(-1)
    return 2 * largest + (np.take_along_axis(normals, largest[:, None], -1)[:, 0] > 0)


def likeness(
    motion: Float[np.ndarray, "4 4"], part: Surface, target: Target, near: float, color: float
) -> Float[np.ndarray, "n"]:
    """How well the points of a part agree with the surface that a motion brings them onto, 0 to 1: in
    position, normal and colour.

    Args:
        motion: the motion.
        part: the part before it.
        target: the surface after it.
        near: largest distance, metres.
        color: largest difference of colours, 0 to 1.
    """
    match = matched(motion, part, target, near)
    fits = (match.far < near) & (match.cosines > SAME_WAY)
    return fits * np.maximum(1 - match.color_distance / color, 0) * np.maximum(1 - (match.off / near) ** 2, 0)
