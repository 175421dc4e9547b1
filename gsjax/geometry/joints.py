"""Joints: how a part can move relative to what it is attached to, and which joint fits an observed motion."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

KINDS = ("prismatic", "revolute")
_FAR_BETTER = 2.0  # a hinge is rejected if its error exceeds that of a turning slide by this factor


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint with a fixed axis, and how far it was open over time.

    Attributes:
        kind: "prismatic" (slides along the axis) or "revolute" (rotates about it, right-handed).
        axis: unit direction of the axis in the world, [3].
        point: a point on the axis, world, metres, [3].
        values: displacement (metres) or angle (radians) at each frame, [T].

    Raises:
        ValueError: a shape or the kind is wrong, or the axis is not of length 1.
    """

    kind: str
    axis: Float[np.ndarray, "..."]
    point: Float[np.ndarray, "..."]
    values: Float[np.ndarray, "..."]

    def __post_init__(self):
        for name, wanted in (("axis", (3,)), ("point", (3,)), ("values", (np.size(self.values),))):
            found = np.shape(getattr(self, name))
            if found != wanted:
                raise ValueError(f"{name}: expected shape {wanted}, found {found}")
        if self.kind not in KINDS:
            raise ValueError(f"kind: expected {' or '.join(KINDS)}, found {self.kind!r}")
        length = float(np.linalg.norm(self.axis))
        if not abs(length - 1) < 1e-4:
            raise ValueError(f"axis: expected a direction of length 1, found length {length:.4g}")

    def motions(self) -> Float[np.ndarray, "frames 4 4"]:
        """Rigid motions, in the world, that take the part from value 0 to its pose at each frame."""
        motions = np.broadcast_to(np.eye(4), (len(self.values), 4, 4)).copy()
        along = self.values[:, None] * self.axis
        if self.kind == "prismatic":
            motions[:, :3, 3] = along
        else:
            motions[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
            motions[:, :3, 3] = self.point - motions[:, :3, :3] @ self.point
        return motions


class FittedJoint(NamedTuple):
    """The joint inferred from a part's motion.

    Attributes:
        kind: "fixed", "prismatic", "revolute", or "free" where no joint explains the motion.
        joint: the fitted joint if `kind` is prismatic or revolute, else None.
        errors_m: root mean square distance, metres, of the part's points from their positions under the best
            fixed, prismatic and revolute joint, by name, and under the best "turning slide": a translation
            along a line with a rotation in proportion to it, which is not a joint.
        confidence: 0 to 1; relative distance of the errors from the decision boundary. At 0, the part is as
            likely free as on a joint, or as likely on the other joint as on this one.
    """

    kind: str
    joint: Joint | None
    errors_m: dict[str, float]
    confidence: float


def fit_joint(
    motions: Float[np.ndarray, "frames 4 4"],
    points: Float[np.ndarray, "points 3"],
    *,
    noise_m: float = 2e-3,
    tolerance: float = 0.03,
    least_turn_rad: float = 0.05,
) -> FittedJoint:
    """The simplest joint that explains a rigid motion.

    A prismatic joint is fitted as a line to the path of the points' centroid. A revolute joint is fitted by
    least squares to that path and to the rotation of the points about their centroid, each weighted by how
    well it is known. Both are judged by the positions to which they move the part's own points.

    Args:
        motions: rigid motions that take the part from its canonical pose to its pose at each frame, in the
            frame of what it is attached to (the world, if that is static).
        points: points of the part in its canonical pose, metres.
        noise_m: a part that moves less than this is fixed, and a smaller error counts as none; metres.
        tolerance: largest error of a joint, as a fraction of the extent of the motion, at which it still
            explains the motion. A box that slides and rotates steadily at the same time is only 4 to 8 % off
            a hinge, so a turning slide is tried as well: if it explains the motion far better, the part is
            free.
        least_turn_rad: a part that rotates by less than this is never revolute, since a small rotation about
            a distant axis looks like a translation; radians.
    """
    moved = np.einsum("tij,nj->tni", motions[:, :3, :3], points) + motions[:, None, :3, 3]
    found = {
        "prismatic": _fit_prismatic(moved - points, points.mean(0)),
        "revolute": _fit_revolute(motions, points),
    }
    errors = {"fixed": _rms(moved - points)}
    for kind, joint in found.items():
        along = joint.motions()
        predicted = np.einsum("tij,nj->tni", along[:, :3, :3], points) + along[:, None, :3, 3]
        errors[kind] = _rms(moved - predicted)
    errors["turning slide"] = _rms(moved - _turning_slide(motions, points))
    if errors["fixed"] <= noise_m:
        return FittedJoint("fixed", None, errors, 1 - errors["fixed"] / noise_m)
    turns = np.ptp(found["revolute"].values) >= least_turn_rad
    kind = min(KINDS if turns else KINDS[:1], key=errors.__getitem__)
    other = KINDS[1 - KINDS.index(kind)] if turns else "fixed"
    allowed = max(noise_m, tolerance * errors["fixed"])
    if kind == "revolute":
        allowed = min(allowed, max(noise_m, _FAR_BETTER * errors["turning slide"]))
    if errors[kind] > allowed:
        return FittedJoint("free", None, errors, 1 - allowed / errors[kind])
    return FittedJoint(kind, found[kind], errors, 1 - errors[kind] / max(min(errors[other], allowed), 1e-12))


def _turning_slide(
    motions: Float[np.ndarray, "frames 4 4"], points: Float[np.ndarray, "points 3"]
) -> Float[np.ndarray, "frames points 3"]:
    """Positions of the points if their centroid moves along a line and they rotate about it in proportion."""
    middle = points.mean(0)
    way = motions[:, :3, :3] @ middle + motions[:, :3, 3] - middle
    turns = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    line, axis = _principal(way), _principal(turns)
    gone, angles = way @ line, np.unwrap(turns @ axis)
    angles = gone * (gone @ angles) / max(gone @ gone, 1e-12)
    about = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    return np.einsum("tij,nj->tni", about, points - middle) + middle + (gone[:, None] * line)[:, None]


def _fit_prismatic(shifts: Float[np.ndarray, "frames points 3"], middle: Float[np.ndarray, "3"]) -> Joint:
    way = shifts.mean(1)
    axis = _principal(way)
    return Joint("prismatic", axis, middle, way @ axis)


def _fit_revolute(motions: Float[np.ndarray, "frames 4 4"], points: Float[np.ndarray, "points 3"]) -> Joint:
    """The hinge that moves the points closest to where these motions move them.

    The rotations determine the axis of a wide part well; for a short handle, the path of its centroid does so
    better. The errors of a first solution determine the weight of each. Given an axis and a point on it, the
    best angles have a closed form, so four numbers are optimised: two each for the axis and the point.
    """
    rotations, middle = motions[:, :3, :3], points.mean(0)
    middles = rotations @ middle + motions[:, :3, 3]
    values, vectors = np.linalg.eigh(np.cov(points.T, bias=True))
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    first = _principal(Rotation.from_matrix(rotations).as_rotvec())
    across = np.linalg.svd(first[None])[2][1:]

    def hinge(found, weight):
        """Axis, offset of a point on it from the centroid, and angles; `weight` is of the centroid's path."""
        axis, offset = first + found[:2] @ across, found[2:] @ across
        axis /= np.linalg.norm(axis)
        arms = np.einsum("ti,j->tij", middles - middle - offset, -offset)
        products = rotations @ spread @ spread.T + weight**2 * arms
        skew = np.stack([products[:, i, j] - products[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
        along = np.einsum("i,tij,j->t", axis, products, axis)
        return axis, offset, np.unwrap(np.arctan2(skew @ axis, np.trace(products, 0, 1, 2) - along))

    def errors(found, weight):
        """Errors of the centroid in each frame, times `weight`, and of the points about it."""
        axis, offset, angles = hinge(found, weight)
        about = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
        return weight * (middles - middle - offset + about @ offset), (rotations - about) @ spread

    def best(found, weight):
        return least_squares(
            lambda x: np.concatenate([e.ravel() for e in errors(x, weight)]), found, x_scale="jac"
        ).x

    from scipy.optimize import least_squares  # slow to import

    about = Rotation.from_rotvec(hinge(np.zeros(4), 0.0)[2][:, None] * first).as_matrix()
    # (I - R)(p - middle) = middle_t - middle; of all p along the axis, the one nearest to the middle.
    offset = np.linalg.lstsq((np.eye(3) - about).reshape(-1, 3), (middles - middle).ravel(), rcond=1e-6)[0]
    equal = best(np.append(np.zeros(2), across @ offset), 1.0)
    path, turn = (np.linalg.norm(e) + 1e-7 for e in errors(equal, 1.0))
    weight = np.clip(turn / path, 0.1, 10.0)
    axis, offset, angles = hinge(best(equal, weight), weight)
    return Joint("revolute", axis, middle + offset, angles)


def _principal(vectors: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "3"]:
    """The principal direction of the vectors, with the sign of the longest one."""
    axis = np.linalg.svd(vectors, full_matrices=False)[2][0]
    longest = vectors[np.argmax(np.linalg.norm(vectors, axis=1))]
    return -axis if longest @ axis < 0 else axis


def _rms(differences: Float[np.ndarray, "frames points 3"]) -> float:
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=-1))))
