"""An infinite sheet deformed by smooth bumps: the map from rest, its inverse, and ray intersections."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_CLOSE_ENOUGH_M = 1e-10
_MOST_STEPS = 30
_HALVINGS = 45
_NUMBERS = 6  # per bump
_SLICES = 48


@dataclass(frozen=True)
class Sheet:
    """The plane z = 0 deformed by Gaussian bumps.

        X(p) = p + sum_b d_b exp(-((x - x_b)^2 + (y - y_b)^2) / (2 s_b^2)),      p = (x, y, z) at rest

    Points above and below the plane move with it. The map is invertible as long as no bump shifts points
    sideways by much more than its width, which the scene has to ensure.

    Attributes:
        bumps: x, y, width s and shift d of each bump, concatenated, metres.

    Raises:
        ValueError: there are not six numbers per bump, or a width is not above 0.
    """

    bumps: tuple[float, ...]

    def __post_init__(self):
        if len(self.bumps) % _NUMBERS or min(self.bumps[2::_NUMBERS], default=1) <= 0:
            found = f"{len(self.bumps)} numbers with widths {self.bumps[2::_NUMBERS]}"
            raise ValueError(f"bumps must be x, y, a width above 0 and a shift each, got {found}")

    def deform(self, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """Map points at rest to the deformed sheet."""
        return self._moved(rest)[0]

    def undo(self, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """The inverse of `deform`, by Newton's method on x and y."""
        rest = points.copy()
        for _ in range(_MOST_STEPS):
            moved, along_x, along_y = self._moved(rest)
            error = points - moved
            rest[:2] += _in_the_plane(along_x, along_y, error)
            rest[2] += error[2]
            if np.abs(error).max(initial=0) < _CLOSE_ENOUGH_M:
                break
        return rest

    def normals(self, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """Unit normals of the upper side at the deformed points of `rest`."""
        _, along_x, along_y = self._moved(rest)
        normal = np.cross(along_x, along_y, axis=0)
        return normal / np.linalg.norm(normal, axis=0)

    def enter(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "3 n"]
    ) -> Float[np.ndarray, "n"]:
        """The s at which rays origin + s directions first meet the sheet, by Newton's method on s and the
        point at rest; infinity for rays that do not point downwards."""
        entry = np.full(directions.shape[1], np.inf)
        downward = np.flatnonzero(directions[2] < 0)
        rays = directions[:, downward]
        s = -origin[2] / rays[2]
        rest = origin[:, None] + s * rays
        rest[2] = 0.0
        for _ in range(_MOST_STEPS):
            moved, along_x, along_y = self._moved(rest)
            error = origin[:, None] + s * rays - moved
            normal = np.cross(along_x, along_y, axis=0)
            step = -np.sum(normal * error, axis=0) / np.sum(normal * rays, axis=0)
            rest[:2] += _in_the_plane(along_x, along_y, error + step * rays)
            s = s + step
            if np.abs(error).max(initial=0) < _CLOSE_ENOUGH_M:
                break
        entry[downward] = np.where(np.abs(error).max(0) < _CLOSE_ENOUGH_M, s, np.inf)
        may_be_steeper = -rays[2] <= self._steepest() * np.hypot(rays[0], rays[1])
        doubtful = downward[may_be_steeper | np.isinf(entry[downward])]
        if doubtful.size:
            entry[doubtful] = self._first(origin, directions[:, doubtful], entry[doubtful])
        return entry

    def _steepest(self) -> float:
        """A slope that the surface nowhere exceeds: the largest within two widths of each bump, with a margin
        for what lies between the places at which it is evaluated."""
        x, y, width = np.reshape(self.bumps, (-1, _NUMBERS))[:, :3, None, None].swapaxes(0, 1)
        across, down = np.meshgrid(*2 * [np.linspace(-2, 2, 25)])
        rest = np.stack([x + width * across, y + width * down, 0 * width * across]).reshape(3, -1)
        normals = self.normals(rest)
        return 1.05 * np.max(np.hypot(normals[0], normals[1]) / normals[2], initial=0)

    def _first(self, origin: np.ndarray, rays: np.ndarray, entry: np.ndarray) -> np.ndarray:
        """`entry` where it is the first crossing of rays that point downwards. Elsewhere, where Newton's
        method found a later one or none, the first is bisected."""
        heights = np.reshape(self.bumps, (-1, _NUMBERS))[:, 5]
        top, bottom = np.maximum(heights, 0).sum(), np.minimum(heights, 0).sum()
        low = np.maximum((top - origin[2]) / rays[2], 0)
        step = ((bottom - origin[2]) / rays[2] - low) / _SLICES
        above = np.arange(len(low))
        for _ in range(_SLICES - 1):
            above = above[self._above(origin, rays[:, above], low[above] + step[above])]
            low[above] += step[above]
        known = (low - _CLOSE_ENOUGH_M <= entry) & (entry <= low + step + _CLOSE_ENOUGH_M)
        lost = np.flatnonzero(~known)
        low, high, rays = low[lost], (low + step)[lost], rays[:, lost]
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            is_above = self._above(origin, rays, middle)
            low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
        entry[lost] = high
        return entry

    def _above(self, origin: np.ndarray, rays: np.ndarray, s: np.ndarray) -> np.ndarray:
        return self.undo(origin[:, None] + s * rays)[2] > 0

    def _moved(self, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """X, dX/dx and dX/dy."""
        moved, along_x, along_y = rest.copy(), np.zeros_like(rest), np.zeros_like(rest)
        along_x[0], along_y[1] = 1.0, 1.0
        for x, y, width, *shift in np.reshape(self.bumps, (-1, _NUMBERS)):
            to_x, to_y = (rest[0] - x) / width, (rest[1] - y) / width
            weight = np.exp(-0.5 * (to_x * to_x + to_y * to_y))
            for axis in np.flatnonzero(shift):
                pull = shift[axis] * weight
                moved[axis] += pull
                along_x[axis] -= pull * to_x / width
                along_y[axis] -= pull * to_y / width
        return moved, along_x, along_y


def _in_the_plane(along_x: np.ndarray, along_y: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Steps in the rest coordinates x and y that cancel the first two coordinates of an error, [2,n]."""
    determinant = along_x[0] * along_y[1] - along_y[0] * along_x[1]
    steps = np.stack(
        [along_y[1] * error[0] - along_y[0] * error[1], along_x[0] * error[1] - along_x[1] * error[0]]
    )
    return steps / determinant
