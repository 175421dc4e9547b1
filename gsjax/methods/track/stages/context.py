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
from gsjax.methods.track.search import SearchResult
from gsjax.methods.track.state import TrackState
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


class UpdateContext(NamedTuple):
    """The input that all stages of one update share.

    Attributes:
        scene: the scene before the update.
        pose: pose of its objects in the last frame.
        state: state of the tracker after the last frame.
        frame: the new frame, of the tracked cameras.
        plan: capacities for rendering.
        images: the new frame in the form that points are compared with.
        centers: centroids of the groups, about which they turn, metres.
        reference: what each group has to look like.
    """

    scene: TrackedScene
    pose: Pose
    state: TrackState
    frame: Frame
    plan: TrackPlan
    images: ToneImages
    centers: Float[Array, "k 3"]
    reference: ReferencePoints


class Past(NamedTuple):
    """What the scene shows before it moves.

    Attributes:
        shown: what it shows in `cameras`.
        cameras: the cameras of the last frame, or those of the new one if the whole scene is redrawn.
        template: the template for matching; None without matching.
        rendered: the whole scene, if it is redrawn; else None.
        backdrop: the background in the new cameras; None if the whole scene is redrawn.
        background: depth of the backdrop, metres, 0 where it does not cover; None like `backdrop`.
        needed: capacity that drawing the background needed.
        counts: number of pixels that show each group.
        visible: groups that enough pixels show.
    """

    shown: Shown
    cameras: Camera
    template: Template | None
    rendered: Rendered | None
    backdrop: Backdrop | None
    background: Float[Array, "c h w"] | None
    needed: Int[Array, ""]
    counts: Float[Array, "k"]
    visible: Bool[Array, "k"]


class Starts(NamedTuple):
    """Hypotheses of where each group has gone.

    Attributes:
        twists: translation, metres, and rotation vector, radians, of each hypothesis.
        delta: initial displacement of each Gaussian, metres.
        found: groups that template matching found.
        score: score of template matching in each camera.
    """

    twists: Float[Array, "h k 6"]
    delta: Float[Array, "m 3"]
    found: Bool[Array, "k"]
    score: Float[Array, "c k"]


class Alignment(NamedTuple):
    """The result of alignment and search.

    Attributes:
        search: the best twist of each group, and where it may be instead.
        points: the points that were aligned.
        reference: the reference points among them, as the last frame saw them.
        suspects: groups that are lost, or may be and whose turn it was to be relocated.
        other_depths: depth of the groups that are not in doubt, metres; else 0.
        needed: capacity that drawing the last scene in the new cameras needed.
    """

    search: SearchResult
    points: Points
    reference: Points
    suspects: Bool[Array, "k"]
    other_depths: Float[Array, "c h w"]
    needed: Int[Array, ""]


class Refined(NamedTuple):
    """The motion after refinement, or as aligned without it.

    Attributes:
        motion: motion of groups and Gaussians.
        residuals: disagreement of each group with the images: 0 perfect, 1 not at all.
        scene: the scene with its background as refined.
        shifts: displacement of each Gaussian of the background; None if that is frozen.
        needed: capacities that the refinement needed.
        info: info of the refinement; empty without it.
    """

    motion: Motion
    residuals: Float[Array, "k"]
    scene: TrackedScene
    shifts: Float[Array, "b 3"] | None
    needed: Needed
    info: dict[str, Any]


class Settled(NamedTuple):
    """Where each group is, and whether it is lost.

    Attributes:
        motion: the motion that is kept.
        confidence: confidence that each group is where it is believed to be.
        elsewhere: groups of which more shows in another place than in their own.
        relocated: those of them that are moved there.
        guesses: twists to where each group may be instead, from its place in the last frame.
    """

    motion: Motion
    confidence: Confidence
    elsewhere: Bool[Array, "k"]
    relocated: Bool[Array, "k"]
    guesses: Float[Array, "k 6"]
