"""Joints: how a part can move against what it is fixed to, and which joint fits a motion that was seen."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

KINDS = ("prismatic", "revolute")


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint whose axis stands still, and how far it was open over time.

    Attributes:
        kind: "prismatic" (slides along the axis) or "revolute" (turns about it, right-handed).
        axis: direction in the world, of length 1, [3].
        point: on the axis, metres, world, [3].
        values: metres or radians, [T].

    Raises:
        ValueError: shapes or the kind are wrong, or the axis is not of length 1.
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
        """The rigid motions of the world that take a part from value 0 to where it was."""
        motions = np.broadcast_to(np.eye(4), (len(self.values), 4, 4)).copy()
        along = self.values[:, None] * self.axis
        if self.kind == "prismatic":
            motions[:, :3, 3] = along
        else:
            motions[:, :3, :3] = Rotation.from_rotvec(along).as_matrix()
            motions[:, :3, 3] = self.point - motions[:, :3, :3] @ self.point
        return motions


class FittedJoint(NamedTuple):
    """What a part's motion says of its joint.

    Attributes:
        kind: "fixed", "prismatic", "revolute", or "free" where no joint explains the motion.
        joint: of that kind; None for the others.
        errors_m: how far points of the part are from where a part that is fixed, prismatic or revolute would
            have them, by name, root mean square.
        confidence: 0 to 1; how far the errors are from where the answer would be another, as a share: 0 is as
            well free as on a joint, or as well on the other joint as on this one.
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
    """The simplest joint that explains a rigid motion, in closed form.

    A slide is the line of the points' middle; a turn has the axis that the rotations share (the first
    principal direction of their rotation vectors), each angle by the nearest rotation about it, and the point
    that these leave in place, in least squares. Each is judged by where it takes the part's own points.

    Args:
        motions: that take the part from its canonical place to where it is, in the frame of what it is fixed
            to (the world, if that stands still).
        points: of the part, canonical, metres.
        noise_m: what moves less is fixed; an error that counts as none.
        tolerance: error of a joint, as a share of the motion's own size, up to which it explains the motion.
            A box that slides and turns steadily at once is 4 to 8 % from a hinge: more allows for noise, and
            calls that box a hinge, of which it is then not very sure.
        least_turn_rad: a turn by less is none: about an axis far away it is as good as a slide.
    """
    moved = np.einsum("tij,nj->tni", motions[:, :3, :3], points) + motions[:, None, :3, 3]
    found = {
        "prismatic": _slide(moved - points, points.mean(0)),
        "revolute": _turn(motions[:, :3, :3], moved.mean(1), points.mean(0)),
    }
    errors = {"fixed": _rms(moved - points)}
    for kind, joint in found.items():
        told = joint.motions()
        predicted = np.einsum("tij,nj->tni", told[:, :3, :3], points) + told[:, None, :3, 3]
        errors[kind] = _rms(moved - predicted)
    if errors["fixed"] <= noise_m:
        return FittedJoint("fixed", None, errors, 1 - errors["fixed"] / noise_m)
    turns = np.ptp(found["revolute"].values) >= least_turn_rad
    kind = min(KINDS if turns else KINDS[:1], key=errors.__getitem__)
    other = KINDS[1 - KINDS.index(kind)] if turns else "fixed"
    allowed = max(noise_m, tolerance * errors["fixed"])
    if errors[kind] > allowed:
        return FittedJoint("free", None, errors, 1 - allowed / errors[kind])
    return FittedJoint(kind, found[kind], errors, 1 - errors[kind] / max(min(errors[other], allowed), 1e-12))


def _slide(shifts: Float[np.ndarray, "frames points 3"], middle: Float[np.ndarray, "3"]) -> Joint:
    way = shifts.mean(1)
    axis = _principal(way)
    return Joint("prismatic", axis, middle, way @ axis)


def _turn(
    rotations: Float[np.ndarray, "frames 3 3"],
    middles: Float[np.ndarray, "frames 3"],
    middle: Float[np.ndarray, "3"],
) -> Joint:
    axis = _principal(Rotation.from_matrix(rotations).as_rotvec())
    skew = np.stack([rotations[:, i, j] - rotations[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    along = np.einsum("i,tij,j->t", axis, rotations, axis)
    angles = np.unwrap(np.arctan2(skew @ axis, np.trace(rotations, axis1=1, axis2=2) - along))
    about = Rotation.from_rotvec(angles[:, None] * axis).as_matrix()
    # (I - R)(p - middle) = middle_t - middle; of all p along the axis the one nearest to the middle.
    offset = np.linalg.lstsq((np.eye(3) - about).reshape(-1, 3), (middles - middle).ravel(), rcond=1e-6)[0]
    return Joint("revolute", axis, middle + offset, angles)


def _principal(vectors: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "3"]:
    """The direction that all share most, to the side to which the longest points."""
    axis = np.linalg.svd(vectors, full_matrices=False)[2][0]
    longest = vectors[np.argmax(np.linalg.norm(vectors, axis=1))]
    return -axis if longest @ axis < 0 else axis


def _rms(differences: Float[np.ndarray, "frames points 3"]) -> float:
    return float(np.sqrt(np.mean(np.sum(differences**2, axis=-1))))
