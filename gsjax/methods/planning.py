"""How the tool gets to a grasp: what is asked of a motion planner, and straight lines, which need none."""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from gsjax.methods.grasping import Grasp


class Path(NamedTuple):
    """Where the tool goes, in order.

    Attributes:
        poses: tool to world, with the axes of `gsjax.methods.grasping`.
        closed: whether the gripper is closed there.
    """

    poses: Float[Array, "s 4 4"]
    closed: Bool[Array, "s"]


class MotionPlanner(Protocol):
    """Plans from where the tool is. It is asked again whenever the grasp has changed."""

    def __call__(self, start: Float[Array, "4 4"], grasp: Grasp) -> Path:
        """A path from `start` to the grasp and on, with the gripper closed at the grasp."""
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
    """Straight lines: to a pose before the grasp, along the tool's z to the grasp, close, and lift.

    How far the pose before the grasp stands back depends on how far off its approach line the tool is, so the
    plan from any point of a plan is the rest of that plan, and a moving object does not send the tool back.
    Nothing is avoided but what `best_grasp` has checked at the grasp.

    Args:
        standoff: how far the pose before the grasp stands back at most, metres.
        funnel: half the angle of the cone about the approach line in which the tool may come nearer, radians.
        lift: how far the closed gripper rises along `up`, metres.
        steps: waypoints of each of the four legs, static.
        start: where the tool is.
        grasp: the goal.
        up: direction of the lift, world.
    """
    goal = jaxlie.SE3.from_matrix(grasp.pose)
    approach = grasp.pose[:3, 2]
    offset = start[:3, 3] - grasp.pose[:3, 3]
    across = jnp.linalg.norm(offset - (offset @ approach) * approach)
    back = jnp.minimum(across / jnp.tan(funnel), standoff)
    behind = jnp.clip(-offset @ approach, 0.0, standoff)  # on the line already: go on from there
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
    """Poses after `start` up to and with `end`: the origin on a line, the axes turning at a constant rate."""
    turn = (start.rotation().inverse() @ end.rotation()).log()
    move = end.translation() - start.translation()

    def at(share):
        rotation = start.rotation() @ jaxlie.SO3.exp(share * turn)
        translation = start.translation() + share * move
        return jaxlie.SE3.from_rotation_and_translation(rotation, translation).as_matrix()

    return jax.vmap(at)(jnp.arange(1, steps + 1) / steps)
