"""The input that all stages of an update share, and the result of each stage."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.track.layers import Backdrop, Shown
from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.matching import Template
from gsjax.methods.track.motion import Motion, Pose
from gsjax.methods.track.plan import Needed, TrackPlan
from gsjax.methods.track.points import Points, ToneImages
from gsjax.methods.track.reference import ReferencePoints
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.state import TrackState
from gsjax.methods.track.watch import SearchResult
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


class UpdateContext(NamedTuple):
    """The input that all stages of one update share."""

    scene: TrackedScene  # before the update
    pose: Pose  # in the last frame
    state: TrackState  # after the last frame
    frame: Frame  # the new one, of the tracked cameras
    plan: TrackPlan
    images: ToneImages  # the new frame as tones and depth, for comparison with points
    centers: Float[Array, "k 3"]  # centroids of the groups, about which they rotate, metres
    reference: ReferencePoints  # what each group looks like, from the first frame


class Past(NamedTuple):
    """What the scene shows before it moves."""

    shown: Shown
    cameras: Camera  # of `shown`: those of the last frame, or the new ones if the whole scene is redrawn
    template: Template | None  # None without template matching
    rendered: Rendered | None  # the whole scene, if it is redrawn; else None
    backdrop: Backdrop | None  # the background in the new cameras; None if the whole scene is redrawn
    background: Float[Array, "c h w"] | None  # its depth, metres, 0 where it has none; None without one
    needed: Int[Array, ""]  # capacity that drawing the background needed
    counts: Float[Array, "k"]  # number of pixels that show each group
    visible: Bool[Array, "k"]  # groups that enough pixels show


class Starts(NamedTuple):
    """Hypotheses of where each group has gone."""

    twists: Float[Array, "h k 6"]  # translation, metres, and rotation vector, radians
    delta: Float[Array, "m 3"]  # initial displacement of each Gaussian, metres
    found: Bool[Array, "k"]  # groups that template matching found
    score: Float[Array, "c k"]  # of template matching


class Alignment(NamedTuple):
    """The result of alignment and search."""

    search: SearchResult
    points: Points  # the points that were aligned
    reference: Points  # the reference points among them, as the last frame saw them
    suspects: Bool[Array, "k"]  # groups that are lost, or may be and are due for relocation
    missed: Bool[Array, "k"]  # those of them that have just jumped and are still far off after shifts
    other_depths: Float[Array, "c h w"]  # depth of the groups that are not in doubt, metres; else 0
    needed: Int[Array, ""]  # capacity that drawing the last scene in the new cameras needed


class Refined(NamedTuple):
    """The motion after refinement, or as aligned without it."""

    motion: Motion
    residuals: Float[Array, "k"]  # disagreement with the images: 0 if perfect, 1 if nothing agrees
    scene: TrackedScene  # with the background as refined
    shifts: Float[Array, "b 3"] | None  # of each Gaussian of the background; None if that is frozen
    needed: Needed  # by the refinement
    info: dict[str, Any]  # of the refinement; empty without it


class Settled(NamedTuple):
    """Where each group is, and whether it is lost."""

    motion: Motion
    confidence: Confidence  # that each group is where it is believed to be
    elsewhere: Bool[Array, "k"]  # groups with stronger evidence in another place than in their own
    relocated: Bool[Array, "k"]  # those of them that are moved there
    guesses: Float[Array, "k 6"]  # twists from the place in the last frame to where each may be instead
