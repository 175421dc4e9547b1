"""Antipodal grasps on labelled points, such as the tracker's Gaussians.

Following Object-Aware Gaussian Splatting for Robotic Manipulation, section III-B: sample grasp poses near the
object's points and take the one with the largest antipodal score. Two contacts hold an object if the line
between them lies in both friction cones (Nguyen, Constructing force-closure grasps, IJRR 1988); on curved
surfaces these are the antipodal points (Chen and Burdick, Finding antipodal point grasps on irregularly
shaped objects, T-RA 1993). The score of a grasp is therefore the smaller of its two contacts' cosines between
outward normal and closing axis. It must be at least that of the friction cone, cos(arctan(friction)).

Tool axes: z is the approach direction, from the palm to the fingertips; y is the closing axis, from one
finger to the other; x = y cross z. The origin lies midway between the centres of the two pads.

**Unobserved surfaces.** With cameras on one side only, objects have no far side. If hardly any surface of the
object faces one of the fingers, that contact is unobserved: the object is assumed to be symmetric, so the
contact gets the cosine of the other one, and the score is multiplied by `unseen`, less than 1, so that a
grasp with two observed contacts is preferred. The width is then that of the observed part, a lower bound.

The fingers close on everything of the object that lies between them, so no part is grasped through another: a
mug's handle can only be grasped from where the body is not in the way.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

_PATCH = 0.005  # depth below the outermost point over which a contact's normals are averaged, metres
_FACING = 0.3  # a surface whose cosine with the closing axis is below this does not face the finger
_SEEN = 0.02  # fraction of an object's points that must face a finger for that side to count as observed
_LEAST = 0.05  # weight of facing points near a contact below which its cosine fades to 0
_TILT = 0.15  # standard deviation of the angle between the contact's normal and the closing axis, radians
_BATCH = 32  # grasps scored at a time, so that intermediate values stay in the cache


@dataclass(frozen=True)
class Gripper:
    """Two parallel fingers and a palm, as boxes; by default the hand of a Franka Panda. Lengths in metres."""

    max_width: float = 0.08
    """Distance between the open fingers."""
    finger_thickness: float = 0.014
    """Size of a finger along y, the closing axis."""
    finger_depth: float = 0.021
    """Size of a finger along x."""
    finger_height: float = 0.046
    """Distance from the palm to the fingertips, along z."""
    tip: float = 0.009
    """Distance from the tool's origin, between the centres of the pads, to the fingertips."""
    palm_width: float = 0.204
    """Size of the palm along y."""
    palm_depth: float = 0.063
    """Size of the palm along x."""
    palm_height: float = 0.066
    """Size of the palm along z, away from the fingers; the arm behind it is left to the planner."""
    friction: float = 1.0
    """Friction coefficient between pads and object; the default is roughly that of rubber."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"Gripper.{name}: expected more than 0, found {value}")


class Grasp(NamedTuple):
    """One grasp.

    Attributes:
        pose: tool to world; see the module's docstring for the axes.
        width: distance between the contacts, metres.
        score: the smaller cosine between a contact's outward normal and the closing axis, 0 to 1.
        feasible: the object fits between the fingers, and neither they nor the palm collide with anything.
    """

    pose: Float[Array, "*batch 4 4"]
    width: Float[Array, "*batch"]
    score: Float[Array, "*batch"]
    feasible: Bool[Array, "*batch"]


def best_grasp(
    key: Key[Array, ""],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    valid: Bool[Array, "n"],
    obstacles: Float[Array, "m 3"],
    obstacle_valid: Bool[Array, "m"],
    gripper: Gripper,
    samples: int = 512,
    *,
    approach: Float[Array, "3"] | None = None,
    max_angle: float = 0.5,
    unseen: float = 0.5,
) -> Grasp:
    """The best of `samples` grasps drawn near the object's points.

    Each sample draws a contact, a closing axis roughly opposite to its normal, and a roll about that axis.
    Which points are drawn depends only on `key` and `valid`, so with a fixed key the samples move with the
    object from frame to frame. If no grasp is feasible, the one with the largest score is returned, with
    `feasible` False.

    Args:
        points, normals: points of the object, and their outward normals, of unit length, or zero where
            unknown. Rows that are not finite are ignored. Points without a normal are never contacts.
        valid: rows to use.
        obstacles, obstacle_valid: points of everything else, and which of them to use.
        gripper: the gripper, static.
        samples: number of grasps to draw, static.
        approach: desired direction of the tool's z, such as straight down onto a table; None allows any.
        max_angle: largest angle between the tool's z and `approach`, radians.
        unseen: weight of a grasp with an unobserved contact, 0 to 1.

    Raises:
        ValueError: `samples` is below 1.
    """
    if samples < 1:
        raise ValueError(f"samples: expected 1 or more, found {samples}")
    limits = {"approach": approach, "max_angle": max_angle}
    poses = sample_poses(key, points, normals, valid, gripper, samples, **limits)
    scene = (points, normals, valid, obstacles, obstacle_valid, gripper)

    def score(pose: Float[Array, "4 4"]) -> Grasp:
        return score_grasp(pose, *scene, **limits, unseen=unseen)

    grasps = jax.lax.map(score, poses, batch_size=min(_BATCH, samples))
    best = jnp.argmax(grasps.score + grasps.feasible)
    return jax.tree.map(lambda leaf: leaf[best], grasps)


def sample_poses(
    key: Key[Array, ""],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    valid: Bool[Array, "n"],
    gripper: Gripper,
    samples: int,
    *,
    approach: Float[Array, "3"] | None = None,
    max_angle: float = 0.5,
) -> Float[Array, "samples 4 4"]:
    """Tool poses that close on a randomly drawn contact; NaN if there is nothing to draw.

    The draws are relative to the object: the direction across a normal points to another point of the object.
    The poses therefore rotate with it; only `approach` is fixed in the world.

    Args:
        key: random key of the draws.
        points, normals, valid, gripper, approach, max_angle: as for `best_grasp`.
        samples: number of poses, static.
    """
    points, normals, valid = _usable(points, normals, valid)
    where, toward, tilt, roll, insert = jax.random.split(key, 5)
    rows = _draw_rows(where, valid & jnp.any(normals != 0, axis=1), samples)
    other = points[_draw_rows(toward, valid, samples)]
    contact, normal = points[rows], normals[rows]
    across = _unit(_reject(other - contact, normal))
    angle = _TILT * jax.random.normal(tilt, (samples, 1), points.dtype)
    y = _unit(jnp.sin(angle) * across - jnp.cos(angle) * normal)
    half = jnp.pi if approach is None else max_angle
    angle = jax.random.uniform(roll, (samples, 1), points.dtype, -half, half)
    z = _unit(_reject(across if approach is None else jnp.broadcast_to(approach, y.shape), y))
    z = jnp.cos(angle) * z + jnp.sin(angle) * jnp.cross(y, z)
    # The contact may lie anywhere on the pad, which extends from the tip equally far beyond its centre.
    along = jax.random.uniform(insert, (samples, 1), points.dtype, -gripper.tip, gripper.tip)
    return _pose(jnp.stack([jnp.cross(y, z), y, z], axis=-1), contact - along * z)


def score_grasp(
    pose: Float[Array, "4 4"],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    valid: Bool[Array, "n"],
    obstacles: Float[Array, "m 3"],
    obstacle_valid: Bool[Array, "m"],
    gripper: Gripper,
    *,
    approach: Float[Array, "3"] | None = None,
    max_angle: float = 0.5,
    unseen: float = 0.5,
) -> Grasp:
    """Close the gripper at `pose` and score the grasp. A grasp can thus be scored again in the next frame.

    The fingers close along y on all points within their extent along x and z, and the pose of the grasp is
    `pose` moved along y to the middle of those points. It is feasible if the points fit between the open
    fingers, both contacts are in the friction cone, and neither the palm nor the closing fingers collide with
    anything. Arguments as for `best_grasp`, and `pose`, the pose of the tool in the world.
    """
    points, normals, valid = _usable(points, normals, valid)
    sound = jnp.isfinite(pose).all()
    pose = jnp.where(sound, pose, jnp.eye(4, dtype=pose.dtype))
    axes = pose[:3, :3]
    local = _into(pose, points)
    between = valid & _at_fingers(local, gripper)
    low = jnp.min(jnp.where(between, local[:, 1], jnp.inf))
    high = jnp.max(jnp.where(between, local[:, 1], -jnp.inf))
    held = jnp.isfinite(low)
    low, high = jnp.where(held, low, 0.0), jnp.where(held, high, 0.0)
    width, middle = high - low, (low + high) / 2

    cosines = _along(normals, axes[:, 1])
    near_seen, far_seen = (jnp.sum(side > _FACING) >= _SEEN * valid.sum() for side in (-cosines, cosines))
    near = _contact(-cosines, local[:, 1] - low, between)
    far = _contact(cosines, high - local[:, 1], between)
    near, far = jnp.where(near_seen, near, far), jnp.where(far_seen, far, near)
    cosine = jnp.where(near_seen | far_seen, jnp.minimum(near, far), 0.0)
    score = jnp.where(sound, cosine * jnp.where(near_seen & far_seen, 1.0, unseen), 0.0)
    holds = held & (score > 0) & (cosine >= 1 / jnp.hypot(1.0, gripper.friction))

    pose = pose.at[:3, 3].add(middle * axes[:, 1])
    in_palm = _in_palm(local - jnp.array([0.0, 1.0, 0.0]) * middle, gripper) & valid
    obstacle_valid = obstacle_valid & jnp.isfinite(obstacles).all(axis=1)
    obstacles = _into(pose, jnp.where(obstacle_valid[:, None], obstacles, 0.0))
    blocked = (_in_fingers(obstacles, width, gripper) | _in_palm(obstacles, gripper)) & obstacle_valid
    feasible = sound & holds & (width <= gripper.max_width) & ~in_palm.any() & ~blocked.any()
    if approach is not None:
        feasible &= axes[:, 2] @ _unit(approach) >= jnp.cos(max_angle)
    return Grasp(pose, width, score, feasible)


def _usable(points, normals, valid):
    """Points and unit normals; rows that are not finite become invalid, and such normals zero."""
    valid = valid & jnp.isfinite(points).all(axis=1)
    points = jnp.where(valid[:, None], points, 0.0)
    known = valid & jnp.isfinite(normals).all(axis=1)
    return points, _unit(jnp.where(known[:, None], normals, 0.0)), valid


def _unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Vectors scaled to length 1; zero where there is no direction."""
    length = jnp.linalg.norm(vectors, axis=-1, keepdims=True)
    return jnp.where(length > 1e-9, vectors / jnp.maximum(length, 1e-9), 0.0)


def _reject(vectors: Float[Array, "n 3"], axes: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The component of each vector orthogonal to its axis."""
    return vectors - jnp.sum(vectors * axes, axis=-1, keepdims=True) * axes


def _draw_rows(key: Key[Array, ""], chosen: Bool[Array, "n"], samples: int):
    """Rows drawn with replacement from the chosen ones; row 0 if there are none."""
    count = jnp.cumsum(chosen)
    rank = 1 + jnp.floor(jax.random.uniform(key, (samples,)) * count[-1])
    return jnp.searchsorted(count, jnp.minimum(rank, count[-1]))


def _pose(rotation: Float[Array, "s 3 3"], origin: Float[Array, "s 3"]) -> Float[Array, "s 4 4"]:
    """Rigid transforms; NaN where the axes are degenerate."""
    is_rotation = jnp.abs(jnp.linalg.det(rotation) - 1) < 1e-3
    top = jnp.concatenate([rotation, origin[..., None]], axis=-1)
    bottom = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0], top.dtype), (len(top), 1, 4))
    return jnp.where(is_rotation[:, None, None], jnp.concatenate([top, bottom], axis=1), jnp.nan)


def _along(vectors: Float[Array, "n 3"], axis: Float[Array, "3"]) -> Float[Array, "n"]:
    """Components along an axis. Elementwise, so that XLA fuses it with what follows, at full precision."""
    return jnp.sum(vectors * axis, axis=-1)


def _into(pose: Float[Array, "4 4"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points in the tool's frame."""
    shifted = points - pose[:3, 3]
    return jnp.stack([_along(shifted, pose[:3, i]) for i in range(3)], axis=-1)


def _at_fingers(local: Float[Array, "n 3"], gripper: Gripper) -> Bool[Array, "n"]:
    """Points within the extent of the fingers along x and z, anywhere along the closing axis."""
    x, _, z = jnp.moveaxis(local, -1, 0)
    return (
        (jnp.abs(x) <= gripper.finger_depth / 2)
        & (z <= gripper.tip)
        & (z >= gripper.tip - gripper.finger_height)
    )


def _in_fingers(local: Float[Array, "n 3"], width: Float[Array, ""], gripper: Gripper) -> Bool[Array, "n"]:
    """Points swept by the fingers while they close from fully open to `width`."""
    beside, outside = jnp.abs(local[:, 1]), gripper.max_width / 2 + gripper.finger_thickness
    return _at_fingers(local, gripper) & (beside > width / 2) & (beside <= outside)


def _in_palm(local: Float[Array, "n 3"], gripper: Gripper) -> Bool[Array, "n"]:
    """Points inside the palm."""
    behind = gripper.tip - gripper.finger_height - local[:, 2]
    beside = jnp.abs(local[:, :2]) <= jnp.array([gripper.palm_depth / 2, gripper.palm_width / 2])
    return beside.all(axis=1) & (behind > 0) & (behind <= gripper.palm_height)


def _contact(
    cosines: Float[Array, "n"], gaps: Float[Array, "n"], between: Bool[Array, "n"]
) -> Float[Array, ""]:
    """Mean cosine of the surface that faces a finger at the contact; 0 if there is none.

    Args:
        cosines: cosine between each outward normal and the direction to the finger.
        gaps: depth of each point below the outermost one, metres.
    """
    facing = jnp.maximum(cosines - _FACING, 0.0)
    weights = jnp.where(between, facing * jnp.exp(-((gaps / _PATCH) ** 2)), 0.0)
    return jnp.minimum(jnp.sum(weights * cosines) / jnp.maximum(weights.sum(), _LEAST), 1.0)
