"""Rigid motions between two surfaces: guesses of all that joints allow, and the motion that fits best near
one (point to plane, Chen and Medioni 1992)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from gsjax.methods.parts.states.surfaces import Surface, unlike

_MOST_CELLS = 4e6  # of the grid that finds nearest points
_BORDER = 4  # cells around it
_ALIKE = np.cos(np.radians(8)), np.cos(np.radians(25))  # normals of one direction, and of two
_FEWEST = 0.02  # share of the normals that makes a direction
_SLIDES = np.arange(0.04, 0.75, 0.03)  # of the size of the scene
_TURNS = np.radians(np.arange(8, 180, 8))
SAME_WAY = 0.6
"""Least cosine between normals that may belong together."""
_CLOSER = 0.75  # by which the reach falls from round to round
_PURE = 0.01  # weight of not sliding along the axis of a turn, relative to the points ...
_PULLED = 0.3  # ... and the longest slide that it counts, in reaches
_TURNS_AT_ALL = 0.05  # radians


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
        shape = np.ceil((high - low) / cell).astype(int) + 2 * _BORDER
        rows = np.full(shape, -1, np.int32)
        places = ((surface.points - self._low) / cell).astype(int)
        inside = ((places >= 0) & (places < shape)).all(-1)
        rows[tuple(places[inside].T)] = np.flatnonzero(inside)
        at = distance_transform_edt(rows < 0, return_distances=False, return_indices=True)
        self._rows = rows[tuple(at)]

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
    """Points after motions."""
    return points @ np.swapaxes(motion[..., :3, :3], -1, -2) + motion[..., None, :3, 3]


def turned(
    motion: Float[np.ndarray, "*k 4 4"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "*k n 3"]:
    """Normals after motions."""
    return normals @ np.swapaxes(motion[..., :3, :3], -1, -2)


def axes_of(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Three perpendicular directions that most of the normals have, as rows.

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
    """Slides along axes, and turns about lines along them through edges and the middle of the points' box.

    Args:
        points: of a part, metres.
        axes: three perpendicular directions.
        size: of the scene, metres.
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
    """The motion near a guess that brings a part onto a surface. Where the surface does not tell, it turns
    without sliding along its axis.

    Args:
        motion: the guess.
        part: before the motion.
        target: the surface after it.
        reach: distance that counts in the first round, metres.
        least: the same in the last ones.
        rounds: number of rounds.
    """
    for k in range(rounds):
        near = max(reach * _CLOSER**k, least)
        at, facing = moved(motion, part.points), turned(motion, part.normals)
        far, rows = target.nearest(at)
        normals = target.surface.normals[rows]
        counts = (far < near) & ((facing * normals).sum(-1) > SAME_WAY)
        if counts.sum() < 6:
            return motion
        at, there, normals = at[counts], target.surface.points[rows[counts]], normals[counts]
        middle = at.mean(0)
        gaps = ((there - at) * normals).sum(-1)
        weights = 1 / (1 + (gaps / (0.3 * near)) ** 2) ** 2
        slopes = np.concatenate([np.cross(at - middle, normals), normals], -1)
        curvature, slope = (slopes * weights[:, None]).T @ slopes, (slopes * weights[:, None]).T @ gaps
        turn = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        if (angle := np.linalg.norm(turn)) > _TURNS_AT_ALL:
            along = np.concatenate([np.zeros(3), turn / angle])
            slid = np.clip(motion[:3, 3] @ along[3:], -_PULLED * near, _PULLED * near)
            curvature += _PURE * len(at) * np.outer(along, along)
            slope -= _PURE * len(at) * slid * along
        damped = curvature + np.diag(1e-5 * np.diag(curvature) + 1e-9 * np.trace(curvature))
        step = np.linalg.solve(damped, slope)
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
        change[:3, 3] = middle + step[3:] - change[:3, :3] @ middle
        motion = change @ motion
    return motion


class Match(NamedTuple):
    """How points after a motion match the surface that is there.

    Attributes:
        far: distances to the nearest points of the surface, metres.
        cosines: between the normals of the two.
        unlike: how unlike their colours are, 0 to 1.
    """

    far: Float[np.ndarray, "*k n"]
    cosines: Float[np.ndarray, "*k n"]
    unlike: Float[np.ndarray, "*k n"]


def matched(motion: Float[np.ndarray, "*k 4 4"], part: Surface, target: Target) -> Match:
    """How the points of a part match a surface, after one motion or each of many.

    Args:
        motion: the motions.
        part: before them.
        target: the surface after them.
    """
    far, rows = target.nearest(moved(motion, part.points))
    cosines = (turned(motion, part.normals) * target.surface.normals[rows]).sum(-1)
    return Match(far, cosines, unlike(part.colors, target.surface.colors[rows]))


def agrees(
    motion: Float[np.ndarray, "4 4"], part: Surface, target: Target, near: float, color: float
) -> Bool[np.ndarray, "n"]:
    """The points of a part that a motion brings onto a surface of their normal and colour.

    Args:
        motion: the motion.
        part: before it.
        target: the surface after it.
        near: distance that counts, metres.
        color: how unlike colours may be, 0 to 1.
    """
    match = matched(motion, part, target)
    return (match.far < near) & (match.cosines > SAME_WAY) & (match.unlike < color)
