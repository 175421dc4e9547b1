"""Motion of the tool to a grasp: the interface of a motion planner, and a straight-line planner."""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from gsjax.methods.grasping import Grasp


class Path(NamedTuple):
    """Waypoints of the tool, in order.

    Attributes:
        poses: tool to world, with the axes of `gsjax.methods.grasping`.
        closed: whether the gripper is closed at each waypoint.
    """

    poses: Float[Array, "s 4 4"]
    closed: Bool[Array, "s"]


class MotionPlanner(Protocol):
    """Plans a path from the current pose of the tool. It is called again whenever the grasp changes."""

    def __call__(self, start: Float[Array, "4 4"], grasp: Grasp) -> Path:
        """A path from `start` to the grasp and beyond, with the gripper closing at the grasp."""
        ...


def straight_line(
    start: Float[Array, "4 4"],
    grasp: Grasp,
    *,
    standoff: float = 0.1,
    funnel: float = 0.5,
    lift: float = 0.15,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    steps: int = 10,
) -> Path:
    """A path of straight lines: to a pre-grasp pose, along the tool's z to the grasp, close, and lift.

    The standoff of the pre-grasp pose depends on the tool's distance from the approach line. Replanning from
    any point of a plan thus gives the rest of that plan, and a moving object does not send the tool back.
    Obstacles are avoided only at the grasp itself, where `best_grasp` has checked them.

    Args:
        start: current pose of the tool, tool to world.
        grasp: the grasp to reach.
        standoff: largest distance of the pre-grasp pose from the grasp, metres.
        funnel: half-angle of the cone around the approach line in which the tool may advance, radians.
        lift: distance by which the closed gripper rises along `up`, metres.
        up: direction of the lift, world.
        steps: waypoints per leg (there are four), static.
    """
    goal = jaxlie.SE3.from_matrix(grasp.pose)
    approach = grasp.pose[:3, 2]
    offset = start[:3, 3] - grasp.pose[:3, 3]
    across = jnp.linalg.norm(offset - (offset @ approach) * approach)
    back = jnp.minimum(across / jnp.tan(funnel), standoff)
    behind = jnp.clip(-offset @ approach, 0.0, standoff)  # already on the line: continue from there
    before = _shifted(goal, -jnp.maximum(back, behind) * approach)
    lifted = _shifted(goal, lift * jnp.asarray(up, approach.dtype))
    first = _leg(jaxlie.SE3.from_matrix(start), before, steps)
    last = _leg(goal, lifted, steps)
    poses = [first, _leg(before, goal, steps), jnp.broadcast_to(grasp.pose, first.shape), last]
    closed = jnp.repeat(jnp.array([False, False, True, True]), steps)
    return Path(jnp.concatenate(poses), closed)


def _shifted(pose: jaxlie.SE3, by: Float[Array, "3"]) -> jaxlie.SE3:
    return jaxlie.SE3.from_rotation_and_translation(pose.rotation(), pose.translation() + by)


def _leg(start: jaxlie.SE3, end: jaxlie.SE3, steps: int) -> Float[Array, "s 4 4"]:
    """Poses after `start`, up to and including `end`: linear in position, at a constant angular velocity."""
    rotvec = (start.rotation().inverse() @ end.rotation()).log()
    move = end.translation() - start.translation()

    def at(share):
        rotation = start.rotation() @ jaxlie.SO3.exp(share * rotvec)
        translation = start.translation() + share * move
        return jaxlie.SE3.from_rotation_and_translation(rotation, translation).as_matrix()

    return jax.vmap(at)(jnp.arange(1, steps + 1) / steps)
