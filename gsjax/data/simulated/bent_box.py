"""A box that twists about its long axis and bends along an arc: the map from rest and its inverse."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# Per metre. Smaller curvatures are raised to this one, 0.1 nm over half a metre, to avoid 0 / 0.
_LEAST_CURVATURE = 1e-9
# Distance from the body, in its radii, within which ray steps use the rest coordinates.
_SHELL = 0.25
_TINY = 1e-300


@dataclass(frozen=True)
class BentBox:
    """A box centred at the origin whose cross-sections rotate and lean in proportion to the height above its
    foot.

    With h = z + half_z, the height above the foot at rest, a = twist / (2 half_z) and k = bend / (2 half_z),

        (x, y, z)  ->  c(h) + B(k h) T(a h) (x, y, 0)
        c(h) = (1 - cos k h) / k d + (sin(k h) / k - half_z) e_z,      d = (cos azimuth, sin azimuth, 0)

    where T rotates about z, and B from z towards d: a uniform twist, then a bend along a circle. The foot
    stays fixed. Cross-sections stay planar, undistorted and perpendicular to the centre line c, an arc of
    radius 1 / k whose length is preserved. The local volume ratio is 1 - k u, where u is the offset towards
    the inner side of the bend, so the total volume is preserved.

    Attributes:
        half_x: half edge at rest, metres.
        half_y: likewise.
        half_z: likewise; half the length of the centre line.
        twist: rotation of the top relative to the foot, radians.
        bend: lean of the top, radians, 0 to pi.
        azimuth: direction of the lean, radians from x towards y.

    Raises:
        ValueError: the bend is negative, closes a ring, or is sharper than the thickness allows.
    """

    half_x: float
    half_y: float
    half_z: float
    twist: float
    bend: float
    azimuth: float

    def __post_init__(self):
        # The circle's centre must lie beyond all points that ray steps within the shell can reach.
        sharpest = min(np.pi, 2 * self.half_z / ((1 + 2 * _SHELL) * self._radius))
        if not 0 <= self.bend < sharpest:
            found = f"bend must be from 0 to {sharpest:.3g} for this box, got {self.bend:.3g}"
            raise ValueError(
                f"{found}; make the box thinner, or rotate the azimuth by pi to bend the other way."
            )

    @property
    def half_extents(self) -> Float[np.ndarray, "3"]:
        """Half edges of a box centred at the origin that contains it."""
        tip = np.abs(self._center(np.array([2 * self.half_z]))[:, 0])
        return np.array([tip[0], tip[1], self.half_z]) + self._radius

    def deform(self, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """Map points of the box at rest to the deformed box."""
        height = rest[2] + self.half_z
        return self._center(height) + self._turn(np.stack([rest[0], rest[1], 0 * height]), height)

    def undo(self, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
        """Map points back to rest: the inverse of `deform` at less than 1 / k from the centre line."""
        k = self._curvature
        along, across = _rotate(points[0], points[1], -self.azimuth)
        up = points[2] + self.half_z
        # In the plane of the arc, relative to its centre, in units of its radius. The branch cut of the angle
        # is opposite the arc's middle.
        x, y = 1 - k * along, k * up
        forward, side = _rotate(x, y, -k * self.half_z)
        height = self.half_z + np.arctan2(side, forward) / k
        # (1 - hypot(x, y)) / k, without cancellation
        inwards = (2 * along - k * (along * along + up * up)) / (1 + np.hypot(x, y))
        rest = _rotate(inwards, across, self.azimuth - self._twist_rate * height)
        return np.stack([*rest, height - self.half_z])

    def undo_directions(
        self, rest: Float[np.ndarray, "3 n"], directions: Float[np.ndarray, "3 n"]
    ) -> Float[np.ndarray, "3 n"]:
        """Directions at the deformed points of `rest`, mapped back to rest coordinates: F^-1 directions.

        F = d deform / d rest = B T [[1, 0, -a y], [0, 1, a x], [0, 0, 1 - k u]].
        """
        height = rest[2] + self.half_z
        along, across = _rotate(directions[0], directions[1], -self.azimuth)
        along, up = _rotate(along, directions[2], self._curvature * height)
        x, y = _rotate(along, across, self.azimuth - self._twist_rate * height)
        z = up / (1 - self._curvature * self._inwards(rest))
        return np.stack([x + self._twist_rate * rest[1] * z, y - self._twist_rate * rest[0] * z, z])

    def carry_normals(
        self, rest: Float[np.ndarray, "3 n"], normals: Float[np.ndarray, "3 n"]
    ) -> Float[np.ndarray, "3 n"]:
        """Unit normals of deformed surfaces through `rest` that have `normals` at rest: F^-T normals."""
        height = rest[2] + self.half_z
        z = normals[2] + self._twist_rate * (rest[1] * normals[0] - rest[0] * normals[1])
        z = z / (1 - self._curvature * self._inwards(rest))
        turned = self._turn(np.stack([normals[0], normals[1], z]), height)
        return turned / np.linalg.norm(turned, axis=0)

    def advance(
        self, points: Float[np.ndarray, "3 n"], directions: Float[np.ndarray, "3 n"]
    ) -> Float[np.ndarray, "n"]:
        """Safe step length in metres of rays from `points` along unit `directions`: no ray enters the body
        within it. 0 on the surface or inside.

        The body lies within its radius of the centre line, so far from that line the step is the distance to
        it minus the radius. Near it, a ray enters only when it is between the faces of all three pairs. If it
        is g > 0 beyond a face, where g changes by g' per metre and |g''| <= m, then after s metres it is at
        least g + g' s - m s^2 / 2 beyond it, which is positive for s below

            s = 2 g / (sqrt(g'^2 + 2 m g) - g').

        Without deformation m is 0 and a ray arrives in one step; otherwise the steps converge quadratically.
        """
        rest = self.undo(points)
        beyond = np.maximum(np.abs(rest) - np.array([[self.half_x], [self.half_y], [self.half_z]]), 0.0)
        slope = np.sign(rest) * self.undo_directions(rest, directions)
        shell = _SHELL * self._radius
        # A step of at most the shell's thickness, from within the shell, ends within twice its thickness.
        most = self._largest_second_derivative(self._radius + 2 * shell)
        root = np.sqrt(slope * slope + 2 * most * beyond)
        outside = (2 * beyond / np.maximum(root - slope, _TINY)).max(0)
        distance = self._off_center(rest)
        near = distance <= self._radius + shell
        return np.where(near, np.minimum(outside, shell), distance - self._radius)

    @property
    def _curvature(self) -> float:
        return max(self.bend / (2 * self.half_z), _LEAST_CURVATURE)

    @property
    def _twist_rate(self) -> float:
        return self.twist / (2 * self.half_z)

    @property
    def _radius(self) -> float:
        return float(np.hypot(self.half_x, self.half_y))

    def _center(self, height: Float[np.ndarray, "n"]) -> Float[np.ndarray, "3 n"]:
        angle, k = self._curvature * height, self._curvature
        lean, up = 2 * np.sin(angle / 2) ** 2 / k, np.sin(angle) / k - self.half_z
        return np.stack([lean * np.cos(self.azimuth), lean * np.sin(self.azimuth), up])

    def _turn(
        self, vectors: Float[np.ndarray, "3 n"], height: Float[np.ndarray, "n"]
    ) -> Float[np.ndarray, "3 n"]:
        """B T applied to each vector: the rotation of the cross-section at its height."""
        along, across = _rotate(vectors[0], vectors[1], self._twist_rate * height - self.azimuth)
        along, up = _rotate(along, vectors[2], -self._curvature * height)
        return np.stack([*_rotate(along, across, self.azimuth), up])

    def _inwards(self, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "n"]:
        """u of the deformed points of `rest`."""
        return _rotate(rest[0], rest[1], self._twist_rate * (rest[2] + self.half_z) - self.azimuth)[0]

    def _off_center(self, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "n"]:
        """A lower bound on the distance of the deformed points of `rest` from the centre line."""
        k, off_axis = self._curvature, np.hypot(rest[0], rest[1])
        over = np.maximum(np.abs(rest[2]) - self.half_z, 0.0)
        # Law of cosines to the nearer end of the arc, with 1 - k off_axis instead of 1 - k u.
        chord = np.maximum(1 - k * off_axis, 0.0) * (2 * np.sin(k * over / 2) / k) ** 2
        return np.sqrt(off_axis * off_axis + chord)

    def _largest_second_derivative(self, widest: float) -> float:
        """Bound on the second derivative of a rest coordinate along a straight line, per metre, no farther
        than `widest` from the centre line.

        For the unit direction e of the line in the frame B T and q = 1 / (1 - k u), z' = q e_z and
        x' = e_x + a y q e_z; and |q'| <= k q^2, |e'| <= q hypot(a, k), the rotation rate of that frame.
        """
        a, k = abs(self._twist_rate), self._curvature
        q = 1 / (1 - k * widest)
        turning = q * np.hypot(a, k)
        lengthwise = k * q * q + q * turning
        sideways = turning + a * (np.hypot(1.0, a * widest * q) * q + widest * lengthwise)
        return float(max(lengthwise, sideways))


def _rotate(x, y, angle):
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y
