"""Static capacities of the tracker's step, and how much of each a step needed."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Int

from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import prepared
from gsjax.methods.track.layers import background_of, moving_of, plan_moving, reduced, thinned
from gsjax.methods.track.motion import Pose, place
from gsjax.methods.track.region import near_background, near_scene
from gsjax.methods.track.scene import TrackedScene
from gsjax.rasterize.plan import Plan, rung
from gsjax.scene.frame import Frame
from gsjax.scene.region import touched_tiles
from gsjax.scene.render import plan_render, render


@jax.tree_util.register_static
@dataclass(frozen=True)
class TrackPlan:
    """Static capacities of a tracker's step.

    Attributes:
        full: plan of the whole scene or, with `redraw` "moving", of the background.
        near: plan of the refined region or, with `redraw` "moving", of the moving Gaussians.
        num_near: number of background Gaussians that may lie in the refined region.
    """

    full: Plan
    near: Plan
    num_near: int

    def grown(self, needed: "Needed", headroom: float) -> "TrackPlan":
        """The plan with every capacity on the lowest rung that holds what was needed."""
        return TrackPlan(
            self.full.grown(int(needed.full), headroom),
            self.near.grown(int(needed.near), headroom),
            max(self.num_near, rung(int(needed.num_near) * headroom)),
        )


class Needed(NamedTuple):
    """How much of each capacity of a `TrackPlan` a step needed."""

    full: Int[Array, ""]
    near: Int[Array, ""]
    num_near: Int[Array, ""]

    def exceeds(self, plan: TrackPlan) -> Bool[Array, ""]:
        """Whether any capacity was too small."""
        num_near = self.num_near > plan.num_near
        return (self.full > plan.full.capacity) | (self.near > plan.near.capacity) | num_near


def plan_tracker(scene: TrackedScene, pose: Pose, frame: Frame, config: TrackConfig) -> TrackPlan:
    """Capacities for a step from `pose`, with the cameras of `frame` and headroom for what motion adds. On
    the host.

    Args:
        scene, pose: the scene, with its slots.
        frame: the frame of all cameras at this pose.
    """
    headroom, (frame, _) = config.headroom, prepared(frame, config)
    if config.redraw == "moving":
        views = reduced(frame.cameras, config.coarseness)
        moving = thinned(moving_of(scene, pose), config.coarseness)
        full = plan_render(background_of(scene), views, headroom=headroom)
        near = plan_moving(moving, views, headroom)
        return TrackPlan(full, near, 0)
    full = plan_render(place(scene, pose), frame.cameras, headroom=headroom)
    rendered = render(place(scene, pose), frame.cameras, full)
    near = near_background(scene, rendered, touched_tiles([pose.means], frame))
    num_near = rung(np.count_nonzero(near) * headroom)
    around = near_scene(scene, near, num_near)
    return TrackPlan(full, plan_render(place(around, pose), frame.cameras, headroom=headroom), num_near)
