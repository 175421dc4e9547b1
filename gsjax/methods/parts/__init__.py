"""MotionSplicer (papers/001): parts of a moving scene, found by their motion without annotation, and edited.

anchor = choose_anchor(views.image, views.num_frames, views.num_cameras)
moved = moved_pixels(views.image, anchor, views.num_cameras)
start = begin(views, gaussians, anchor, moved, config, segmenter, key)  # gaussians: as at the anchor
for followed in follow(views, start, first_parts(start, views.num_frames, config), config): ...
parts, _ = without_needless(views, followed.parts, config)
for refined in refine(views, parts, config): parts = refined.parts
scene, trajectory = outcome(start, parts, times)

config.py    what can be set              stream.py   one step of the optimisation
anchor.py    which frame is canonical     unify.py    which parts are one
masks.py     what moves in every view     follow.py   the loop over frames
lift.py      from masks to Gaussians      finish.py   what no picture needs is given up
weights.py   the grid of weights          trajectory.py  what comes of it, and what edits work on
discover.py  all that, before any motion  refine.py   all frames together, in the end
"""

from gsjax.methods.parts.anchor import Anchor, choose_anchor, moved_pixels
from gsjax.methods.parts.config import (
    DiscoverConfig,
    PartsConfig,
    RefineConfig,
    StreamConfig,
    UnifyConfig,
)
from gsjax.methods.parts.discover import Start, Views, begin
from gsjax.methods.parts.finish import outcome, without_needless
from gsjax.methods.parts.follow import Followed, Parts, first_parts, follow
from gsjax.methods.parts.masks import masks_of_labels
from gsjax.methods.parts.refine import Refined, refine
from gsjax.methods.parts.stream import Canonical, StreamBatch, StreamParams, stream_loss, stream_step
from gsjax.methods.parts.trajectory import (
    BACKGROUND,
    Moment,
    PartScene,
    Trajectory,
    gaussians_at,
    moment,
    still,
    trajectory_of,
)

__all__ = [
    "BACKGROUND",
    "Anchor",
    "Canonical",
    "DiscoverConfig",
    "Followed",
    "Moment",
    "PartScene",
    "Parts",
    "PartsConfig",
    "RefineConfig",
    "Refined",
    "Start",
    "StreamBatch",
    "StreamConfig",
    "StreamParams",
    "Trajectory",
    "UnifyConfig",
    "Views",
    "begin",
    "choose_anchor",
    "first_parts",
    "follow",
    "gaussians_at",
    "masks_of_labels",
    "moment",
    "moved_pixels",
    "outcome",
    "refine",
    "still",
    "stream_loss",
    "stream_step",
    "trajectory_of",
    "without_needless",
]
