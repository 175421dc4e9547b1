"""What a scene shows in the cameras of a frame, and the part of it that the next frame needs."""

from jaxtyping import Array, Int

from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import Backdrop, Shown, render_labels, show_moving, shown_by
from gsjax.methods.track.motion import Pose
from gsjax.methods.track.plan import TrackPlan
from gsjax.methods.track.scene import TrackedScene
from gsjax.scene.frame import Frame


def show(
    scene: TrackedScene,
    pose: Pose,
    frame: Frame,
    backdrop: Backdrop | None,
    plan: TrackPlan,
    config: TrackConfig,
) -> tuple[Shown, Int[Array, ""]]:
    """What the scene shows in the frame's cameras, and the capacity needed: of `plan.near` over a backdrop,
    of `plan.full` without one, where the whole scene is drawn."""
    if backdrop is None:
        rendered = render_labels(scene, pose, frame, plan.full)
        return shown_by(rendered), rendered.meta.needed.max()
    return show_moving(scene, pose, backdrop, plan.near, config.coarseness)


def stored_view(shown: Shown, backdrop: Backdrop | None, frame: Frame, config: TrackConfig) -> tuple:
    """The last three fields of `TrackState`: None if the whole scene is redrawn in each frame."""
    if config.redraw != "moving":
        return None, None, None
    return shown, backdrop, frame.images if config.matching else None
