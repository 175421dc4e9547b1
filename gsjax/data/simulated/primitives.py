"""Solids, a plane and a sheet: ray intersections and normals. Rays are columns, [3,N].

Every intersection solves for the smallest s > 0 at which origin + s * direction enters the solid; s is
infinite for rays that miss it or start inside.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from gsjax.data.simulated.bent_box import BentBox
from gsjax.data.simulated.sheet import Sheet
from gsjax.data.simulated.textures import Texture

_TINY = 1e-300
# A ray has entered a bent box when its safe step is below this, metres; without convergence it is a miss.
_ON_SURFACE_M = 1e-10
_MOST_STEPS = 200


@dataclass(frozen=True, eq=False)
class Primitive:
    """One solid of a body.

    Attributes:
        shape: "box", "sphere", "cylinder" (about z), "plane" (z = 0, seen from above), "bent box" or "sheet".
        size: metres, by shape: three half edges; a radius; a radius and half a length; nothing; the fields of
            `BentBox`; the bumps of a `Sheet`.
        texture: its colours, in coordinates of the primitive at rest, so that they move and deform with it.
        body: index of the body to which it is attached.
        pose: primitive to body, [4,4].
    """

    shape: Literal["box", "sphere", "cylinder", "plane", "bent box", "sheet"]
    size: tuple[float, ...]
    texture: Texture
    body: int = 0
    pose: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))

    @property
    def half_extents(self) -> Float[np.ndarray, "3"]:
        """Half edges of its bounding box; infinite for a plane and a sheet."""
        match self.shape:
            case "box":
                return np.array(self.size)
            case "sphere":
                return np.full(3, self.size[0])
            case "cylinder":
                return np.array([self.size[0], self.size[0], self.size[1]])
            case "bent box":
                return BentBox(*self.size).half_extents
            case "sheet":
                return np.full(3, np.inf)
        return np.array([np.inf, np.inf, 0.0])


def intersect(
    primitive: Primitive, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "3 n"]
) -> Float[np.ndarray, "n"]:
    """Intersect rays from one point with a primitive, in its frame: s of the entry point, or infinity.

    Args:
        primitive: the primitive.
        origin: origin of all rays, metres.
        directions: ray directions of any length; s is in units of it.
    """
    match primitive.shape:
        case "box":
            near, far = _slabs(primitive.size, origin, directions, axes=(0, 1, 2))
        case "sphere":
            near, far = _quadric(primitive.size[0], origin, directions)
        case "cylinder":
            radius, half = primitive.size
            near, far = _quadric(radius, origin[:2], directions[:2])
            low, high = _slabs((0.0, 0.0, half), origin, directions, axes=(2,))
            near, far = np.maximum(near, low), np.minimum(far, high)
        case "plane":
            downward = directions[2] < 0
            near = far = np.where(downward, -origin[2] / np.where(downward, directions[2], 1.0), np.inf)
        case "bent box":
            within = _slabs(primitive.half_extents, origin, directions, axes=(0, 1, 2))
            near = far = _march(BentBox(*primitive.size), origin, directions, *within)
        case "sheet":
            near = far = Sheet(primitive.size).enter(origin, directions)
    return np.where((near <= far) & (near > 0) & np.isfinite(near), near, np.inf)


def normals(primitive: Primitive, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Outward unit normals at points of the surface, in the primitive's frame."""
    match primitive.shape:
        case "box":
            return _box_normals(primitive.size, points)
        case "bent box":
            box = BentBox(*primitive.size)
            rest = box.undo(points)
            return box.carry_normals(rest, _box_normals(primitive.size[:3], rest))
        case "sheet":
            sheet = Sheet(primitive.size)
            return sheet.normals(sheet.undo(points))
        case "sphere":
            return points / primitive.size[0]
        case "cylinder":
            radius, half = primitive.size
            distance = np.hypot(points[0], points[1])
            on_cap = np.abs(points[2]) - half > distance - radius
            side = points * np.array([[1.0], [1.0], [0.0]]) / np.maximum(distance, _TINY)
            return np.where(on_cap, np.array([[0.0], [0.0], [1.0]]) * np.sign(points), side)
    return np.broadcast_to(np.array([[0.0], [0.0], [1.0]]), points.shape)


def at_rest(primitive: Primitive, points: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Map points of the primitive, in its frame, back to its undeformed state."""
    deformation = _deformation(primitive)
    return points if deformation is None else deformation.undo(points)


def deformed(primitive: Primitive, rest: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "3 n"]:
    """Map points of the undeformed primitive to its deformed state, in its frame: inverse of `at_rest`."""
    deformation = _deformation(primitive)
    return rest if deformation is None else deformation.deform(rest)


def _deformation(primitive: Primitive) -> BentBox | Sheet | None:
    """The deformation of a primitive; None if it is rigid."""
    match primitive.shape:
        case "bent box":
            return BentBox(*primitive.size)
        case "sheet":
            return Sheet(primitive.size)
    return None


def _box_normals(half, points):
    axis = np.argmax(np.abs(points) - np.array(half)[:, None], axis=0)
    return np.where(np.arange(3)[:, None] == axis, np.sign(points), 0.0)


def _march(box, origin, directions, near, far):
    """Entry points of rays into a bent box between `near` and `far`; 0 for a ray that starts inside."""
    speed = np.linalg.norm(directions, axis=0)
    unit = directions / speed
    s, entry = np.maximum(near, 0.0), np.full_like(speed, np.inf)
    active = np.flatnonzero(s <= far)
    for _ in range(_MOST_STEPS):
        if not active.size:
            break
        rays = unit[:, active]
        step = box.advance(origin[:, None] + rays * (s * speed)[active], rays)
        arrived = step < _ON_SURFACE_M
        s[active] += step / speed[active]
        entry[active[arrived]] = s[active[arrived]]
        active = active[~arrived & (s[active] <= far[active])]
    return entry


def _slabs(half, origin, directions, axes):
    """The interval of each ray between pairs of planes at +-half."""
    near, far = -np.inf, np.inf
    for i in axes:
        inverse = 1.0 / np.where(np.abs(directions[i]) < _TINY, _TINY, directions[i])
        a, b = (-half[i] - origin[i]) * inverse, (half[i] - origin[i]) * inverse
        near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
    return near, far


def _quadric(radius, origin, directions):
    """The interval of each ray within a sphere, or, with two coordinates, within an infinite cylinder."""
    a = np.maximum(np.einsum("ij,ij->j", directions, directions), _TINY)
    b = origin @ directions
    discriminant = b * b - a * (origin @ origin - radius * radius)
    root = np.sqrt(np.maximum(discriminant, 0.0))
    hit = discriminant > 0
    return np.where(hit, (-b - root) / a, np.inf), np.where(hit, (-b + root) / a, -np.inf)
