"""What a scene shows to the cameras of a frame, and what of it the next frame needs."""

import jax
from jaxtyping import Array, Int

from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.layers import Backdrop, Shown, render_labels, show_moving, shown_by
from gsjax.methods.track.motion import Pose
from gsjax.methods.track.plan import TrackPlan
from gsjax.methods.track.points import Points, Sight, pixels_of_groups
from gsjax.methods.track.recover import with_unexplained
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
    """What the scene shows, and what capacity that took (`near` over a backdrop, else `full`).

    Args:
        scene, pose: as they stand.
        frame: with the cameras.
        backdrop: the background; None where the whole scene is drawn.
        plan: capacities to draw with.
        config: the tracker's.
    """
    if backdrop is None:
        rendered = render_labels(scene, pose, frame, plan.full)
        return shown_by(rendered), rendered.meta.needed.max()
    return show_moving(scene, pose, backdrop, plan.near, config.coarseness)


def pixels_shown(shown: Shown, sight: Sight, num_objects: int, config: TrackConfig) -> tuple[Points, Points]:
    """Pixels that show each group, and those that none explains.

    Args:
        shown: what the scene shows.
        sight: what the cameras see.
        num_objects: K, static.
        config: the tracker's.
    """
    gaps = (config.grow.min_gap, config.align.max_thickness)
    labelled = with_unexplained(shown, sight, num_objects, *gaps, config.coarseness)
    how = (num_objects + 1, config.align, config.coarseness)
    pixels = pixels_of_groups(sight, labelled.labels, labelled.depths, *how)
    return jax.tree.map(lambda a: a[:-1], pixels), jax.tree.map(lambda a: a[-1], pixels)


def memory_of(shown: Shown, backdrop: Backdrop | None, frame: Frame, config: TrackConfig) -> tuple:
    """What the next frame looks back on, where the last scene is not drawn again: the last three fields of
    `TrackState`."""
    if config.redraw != "moving":
        return None, None, None
    return shown, backdrop, frame.images if config.matching else None
