"""Parameters, state and batch of the tracker's step."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.track.config import TrackConfig
from gsjax.methods.track.frames import FrameShape
from gsjax.methods.track.layers import Backdrop, Shown
from gsjax.methods.track.motion import Motion, Pose, place
from gsjax.methods.track.plan import TrackPlan
from gsjax.methods.track.points import Keyframe, Points, first_keyframe
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.watch import Watch, first_watch
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians


class Tracked(NamedTuple):
    """A scene and the pose of its objects: the parameters of the step, and the result of tracking.

    Attributes:
        scene: the scene, with the Gaussians that have joined and the slots that are left.
        pose: pose of the moving Gaussians.
    """

    scene: TrackedScene
    pose: Pose

    def __repr__(self) -> str:
        return f"Tracked({self.scene.num_objects} objects, {len(self.labels):,} Gaussians)"

    def gaussians(self) -> Gaussians:
        """The whole scene at this pose; empty slots are transparent."""
        return place(self.scene, self.pose)

    @property
    def labels(self) -> Int[Array, "n"]:
        """Group of each Gaussian: 0 the background, 1..K the rigid groups, of which an object may have
        several, K+1 an empty slot."""
        return self.scene.labels

    @property
    def mask_values(self) -> Int[Array, "n"]:
        """Mask value of the object that each Gaussian belongs to: 0 the background, -1 an empty slot."""
        return jnp.asarray((*self.scene.label_ids, -1))[self.labels]


class TrackState(NamedTuple):
    """The state that the tracker carries from frame to frame.

    Attributes:
        motion: motion of the last frame: the initial delta, and the constant-velocity hypothesis.
        pixels: pixels that showed each group in the last frame.
        keyframe: pixels that showed it in an earlier frame.
        relocation_guesses: for groups that may be elsewhere, the twist from where they are believed to be:
            translation, metres, and rotation vector, radians.
        watch: record of how each group has been followed.
        count: number of frames after the first one; -1 before that.
        shown: what the scene showed in the last frame; None if the whole scene is redrawn.
        backdrop: the background over which `shown` was drawn; None if the whole scene is redrawn.
        images: images of the last frame if templates are taken from them; else None.
    """

    motion: Motion
    pixels: Points
    keyframe: Keyframe
    relocation_guesses: Float[Array, "k 6"]
    watch: Watch
    count: Int[Array, ""]
    shown: Shown | None
    backdrop: Backdrop | None
    images: Float[Array, "c height width 3"] | None

    @property
    def is_blank(self) -> Bool[Array, ""]:
        """Whether no frame has been seen yet."""
        return self.count < 0


class TrackBatch(NamedTuple):
    """The input of a step.

    Attributes:
        frame: the frame of all cameras.
        plan: capacities for rendering.
        everywhere: number of groups for which rotations or other places are tried; None: as configured.
    """

    frame: Frame
    plan: TrackPlan
    everywhere: Int[Array, ""] | None = None


@partial(jax.jit, static_argnums=(1, 2), inline=True)
def blank_state(params: Tracked, config: TrackConfig, shape: FrameShape) -> TrackState:
    """The state of a tracker that has seen no frame yet: no pixel shows any group, and nothing was drawn.

    An update from here, to the frame that the scene shows, changes no parameters: it only stores what it saw.
    `params` is the scene and the pose of its objects, `shape` that of the frames to come.
    """
    scene, pose = params
    dtype, groups = pose.means.dtype, scene.num_objects
    cameras = len(config.cameras) or shape.cameras
    width, height = shape.width // config.shrink, shape.height // config.shrink
    nowhere = jnp.zeros((groups, 6), dtype)
    vectors, weights = (cameras, 3, config.align.pixels), (cameras, config.align.pixels)
    pixels = Points(*(jnp.zeros((groups, *size), dtype) for size in (vectors, vectors, weights)))
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
        nowhere,
        first_watch(jnp.zeros(groups, dtype)),
        jnp.int32(-1),
        shown,
        backdrop,
        images,
    )
