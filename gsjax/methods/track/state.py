"""What the tracker's step advances, what it carries from frame to frame, and what it is given."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape
from gsjax.methods.track.layers import Backdrop, Shown
from gsjax.methods.track.motion import Motion, Pose, place
from gsjax.methods.track.plan import TrackPlan
from gsjax.methods.track.points import Keyframe, Points, first_keyframe
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.search import Watch, first_watch
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians


class Tracked(NamedTuple):
    """A scene and where its objects are: the parameters of the step, and the result of tracking.

    Attributes:
        scene: the scene, with slots for what joins objects and what has joined so far.
        pose: where the moving Gaussians are.
    """

    scene: TrackedScene
    pose: Pose

    def gaussians(self) -> Gaussians:
        """The whole scene as it stands; empty slots are transparent."""
        return place(self.scene, self.pose)

    @property
    def labels(self) -> Int[Array, "n"]:
        """Group of each Gaussian: 0 the background, 1..K the objects; K+1 for an empty slot."""
        return self.scene.labels


class TrackState(NamedTuple):
    """What the tracker carries from frame to frame.

    Attributes:
        motion: of the last frame: where delta starts, and the constant-velocity hypothesis.
        pixels: those that showed each group in the last frame.
        keyframe: and in an earlier one.
        unexplained_pixels: pixels of the last frame that no group explains.
        relocation_guesses: where each group that may be elsewhere is then, from where it is believed to be:
            translation, metres, and rotation vector, radians.
        watch: how each group has been followed.
        count: frames so far.
        shown: what the last frame showed; None where the whole scene is drawn again.
        backdrop: the background that this was drawn over; None like `shown`.
        images: of the last frame, where templates are taken from them; else None.
    """

    motion: Motion
    pixels: Points
    keyframe: Keyframe
    unexplained_pixels: Points
    relocation_guesses: Float[Array, "k 6"]
    watch: Watch
    count: Int[Array, ""]
    shown: Shown | None
    backdrop: Backdrop | None
    images: Float[Array, "c height width 3"] | None


class TrackBatch(NamedTuple):
    """What a step is given.

    Attributes:
        frame: what all cameras saw.
        plan: capacities to draw with.
        everywhere: how many groups to look for everywhere; None: as many as the config says.
    """

    frame: Frame
    plan: TrackPlan
    everywhere: Int[Array, ""] | None = None


def blank_state(params: Tracked, config: TrackConfig, shape: FrameShape) -> TrackState:
    """The state of a tracker that has seen nothing yet: no pixel shows any group, and nothing was drawn.

    An update from here moves no group of which only pixels would tell, and remembers what it saw.

    Args:
        params: the scene and where its objects are.
        config: the tracker's.
        shape: of the frames to come.
    """
    scene, pose = params
    dtype, groups = pose.means.dtype, scene.num_objects
    cameras = len(config.cameras) or shape.cameras
    width, height = shape.width // config.shrink, shape.height // config.shrink
    nowhere = jnp.zeros((groups, 6), dtype)
    places, seen = (cameras, 3, config.align.pixels), (cameras, config.align.pixels)
    unexplained = Points(*(jnp.zeros(form, dtype) for form in (places, places, seen)))
    pixels = Points(*(jnp.zeros((groups, *of_one.shape), dtype) for of_one in unexplained))
    shown = backdrop = images = None
    if config.redraw == "moving":
        columns, rows = (-(-size // config.coarseness) for size in (width, height))
        views = Camera(
            jnp.zeros((cameras, 4, 4), dtype), jnp.zeros((cameras, 3, 3), dtype), columns, rows, shape.near
        )
        empty = jnp.zeros((cameras, rows, columns), dtype)
        shown, backdrop = Shown(empty.astype(jnp.int32), empty, empty > 0), Backdrop(views, empty, empty)
        images = jnp.zeros((cameras, height, width, 3), dtype) if config.matching else None
    return TrackState(
        Motion(nowhere, jnp.zeros_like(pose.means)),
        pixels,
        first_keyframe(pixels),
        unexplained,
        nowhere,
        first_watch(jnp.zeros(groups, dtype)),
        jnp.int32(0),
        shown,
        backdrop,
        images,
    )
