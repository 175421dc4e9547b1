"""What the stages of an update share, and what each of them hands to the next."""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int

from gsjax.geometry.cameras import Camera
from gsjax.methods.track.layers import Backdrop, Shown
from gsjax.methods.track.lost import Confidence
from gsjax.methods.track.matching import Template
from gsjax.methods.track.motion import Motion, Pose
from gsjax.methods.track.plan import Needed, TrackPlan
from gsjax.methods.track.points import Points, Sight
from gsjax.methods.track.reference import ReferencePoints
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.search import Sought
from gsjax.methods.track.state import TrackState
from gsjax.scene.frame import Frame
from gsjax.scene.render import Rendered


class Moment(NamedTuple):
    """What all stages of one update share.

    Attributes:
        scene: before the update.
        pose: of its objects in the last frame.
        state: of the tracker after the last frame.
        frame: what the tracked cameras see now.
        plan: capacities to draw with.
        sight: the frame as points are compared with it.
        centers: what groups turn about.
        reference: what each group has to look like.
    """

    scene: TrackedScene
    pose: Pose
    state: TrackState
    frame: Frame
    plan: TrackPlan
    sight: Sight
    centers: Float[Array, "k 3"]
    reference: ReferencePoints

    @property
    def groups(self) -> Int[Array, "m"]:
        """Group of each moving Gaussian."""
        return self.scene.labels[: self.scene.num_moving]


class Past(NamedTuple):
    """What the last scene shows, before it has moved.

    Attributes:
        shown: to the cameras of the last frame or, where the whole scene is drawn, to those of now.
        cameras: that it is shown to.
        template: what template matching looks for; None without.
        rendered: the whole scene, where that is drawn; else None.
        backdrop: the background for the cameras of now; None where the whole scene is drawn.
        background: its depth, metres, 0 where it does not cover; None like `backdrop`.
        drawn: what capacity drawing the background took.
        counts: pixels that show each group.
        visible: groups that enough pixels show.
    """

    shown: Shown
    cameras: Camera
    template: Template | None
    rendered: Rendered | None
    backdrop: Backdrop | None
    background: Float[Array, "c h w"] | None
    drawn: Int[Array, ""]
    counts: Float[Array, "k"]
    visible: Bool[Array, "k"]


class Starts(NamedTuple):
    """Where each group may have gone.

    Attributes:
        twists: hypotheses: translation, metres, and rotation vector, radians.
        delta: with which each Gaussian goes on, metres.
        found: groups that template matching found.
        score: of template matching, in each camera.
    """

    twists: Float[Array, "h k 6"]
    delta: Float[Array, "m 3"]
    found: Bool[Array, "k"]
    score: Float[Array, "c k"]


class Hunt(NamedTuple):
    """The result of alignment and search.

    Attributes:
        sought: the best twist of each group, and where it may be instead.
        points: with which groups were aligned.
        named: those of them that the first mask named, as the last frame saw them.
        astray: groups that were looked for elsewhere if it was their turn.
        others: depth of groups that are not in doubt, metres; else 0.
        near: what capacity it took to draw the last scene for the cameras of now.
    """

    sought: Sought
    points: Points
    named: Points
    astray: Bool[Array, "k"]
    others: Float[Array, "c h w"]
    near: Int[Array, ""]


class Refined(NamedTuple):
    """The motion after refinement, or as it was aligned where there is none.

    Attributes:
        motion: of groups and Gaussians.
        residual: how badly each group agrees with the images: 0 perfect, 1 not at all.
        scene: with its background where it is now.
        shifted: how far each Gaussian of the background moved; None if that is frozen.
        needed: of the plan.
        info: of the refinement; empty where there is none.
    """

    motion: Motion
    residual: Float[Array, "k"]
    scene: TrackedScene
    shifted: Float[Array, "b 3"] | None
    needed: Needed
    info: dict[str, Any]


class Settled(NamedTuple):
    """Where each group is, and whether it is lost.

    Attributes:
        motion: that is kept.
        sure: whether each group is where it is believed to be.
        elsewhere: groups of which more is seen in another place than in theirs.
        retaken: those of them that are moved there.
        guesses: where each group may be instead, from where it was in the last frame.
    """

    motion: Motion
    sure: Confidence
    elsewhere: Bool[Array, "k"]
    retaken: Bool[Array, "k"]
    guesses: Float[Array, "k 6"]
