"""The tracker as a method (see `gsjax.optim.method`). Its frames are not steps of an optimisation, so it is
run by the generator of `gsjax.engine.track.tracking` instead of `drive`, with the same runs and ticks."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from gsjax.geometry.sight import pixels_at
from gsjax.losses.extra import ExtraLosses, named_losses
from gsjax.methods.track.budget import Chosen
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape, expect_pinholes, prepared, shape_of
from gsjax.methods.track.grow import with_slots
from gsjax.methods.track.motion import first_pose
from gsjax.methods.track.plan import plan_tracker
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.state import Tracked, blank_state
from gsjax.methods.track.update import track_step
from gsjax.optim.method import Run
from gsjax.optim.step import Step
from gsjax.scene.frame import Frame

PLAN = "track"
"""Name of the plan in `Run.plans`."""


class Kept(NamedTuple):
    """What a run stores beside parameters, state and plan.

    Attributes:
        reduction: factor by which images shrink for template matching.
        chosen: settings chosen for a time budget; None without one.
    """

    reduction: int
    chosen: Chosen | None = None


@dataclass(frozen=True)
class Track:
    """The object-aware tracker.

    Attributes:
        config: configuration of the tracker.
        extra_losses: custom losses of the refinement; see `track_step`.
    """

    config: TrackConfig = field(default_factory=TrackConfig)
    extra_losses: ExtraLosses = ()

    def __post_init__(self):
        named_losses(self.extra_losses)

    def start(self, scene: TrackedScene, first: Frame, like: Run | None = None) -> tuple[FrameShape, Run]:
        """The shape of the frames and a run that has seen no frame yet, with slots if there is depth. Its
        first update, to the frame that the scene shows, only observes.

        Args:
            scene: from `start_scene` or `scene_from_shapes`.
            first: the frame that it shows, of all cameras.
            like: an earlier run of a scene of the same shapes, whose plans are reused.
        """
        if self.config.grow.slots and first.depths is not None:
            scene = with_slots(scene, self.config.grow.slots)
        return self.start_at(Tracked(scene, first_pose(scene)), first, like)

    def start_at(self, params: Tracked, frame: Frame, like: Run | None = None) -> tuple[FrameShape, Run]:
        """The same, for a scene that already has its slots, and shows `frame` at the pose of `params`.

        Args:
            params: the scene and the pose.
            frame: of all cameras.
            like: see `start`; a plan that is too small for this scene grows in the first update.

        Raises:
            ValueError: the cameras are fisheyes.
        """
        expect_pinholes(frame)
        if like is None:
            plan = plan_tracker(params.scene, params.pose, frame, self.config)
        else:
            plan = like.plans[PLAN]
        shape, kept = shape_of(frame), Kept(matching_reduction(params.scene, frame, self.config))
        return shape, Run(params, blank_state(params, self.config, shape), 0, {PLAN: plan}, kept)

    def step(self, shape: FrameShape, reduction: int = 1) -> Step:
        """See `track_step`."""
        return track_step(self.config, shape, reduction, self.extra_losses)

    def result(self, problem: FrameShape | None, run: Run) -> Tracked:
        """The scene and the pose of its objects."""
        return run.params


def matching_reduction(scene: TrackedScene, frame: Frame, config: TrackConfig) -> int:
    """Factor by which images of all cameras shrink for matching, so that the second largest object fits the
    template: the largest is usually a robot, far larger than what it handles. On the host."""
    if not config.matching:
        return 1
    frame, _ = prepared(frame, config)
    groups = np.asarray(scene.labels)[: scene.num_moving]
    means = np.asarray(scene.gaussians.means, np.float64)[: scene.num_moving]
    sizes = []
    for viewmat, K in zip(np.asarray(frame.cameras.viewmat), np.asarray(frame.cameras.K), strict=True):
        pixels, depths = pixels_at(means @ viewmat[:3, :3].T + viewmat[:3, 3], K)
        pixels = np.clip(pixels, 0, (frame.cameras.width, frame.cameras.height))
        seen = depths > frame.cameras.near
        visible = [pixels[seen & (groups == k)] for k in range(1, scene.num_objects + 1)]
        sizes.append([np.ptp(places, axis=0).max() if len(places) else 0.0 for places in visible])
    shown = sorted(size for size in np.max(sizes, axis=0) if size > 0)  # no empty slots
    size = shown[-2:][0] if shown else 0.0
    return max(1, int(np.ceil(size / config.match.patch)))
