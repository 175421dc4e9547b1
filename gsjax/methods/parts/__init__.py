"""Parts of a moving scene, found by their motion without annotation, and edited (MotionSplicer).

anchor = choose_anchor(sequence.image, sequence.num_frames, sequence.num_cameras)
moved = moved_pixels(sequence.image, anchor, sequence.num_cameras)
start = begin(sequence, gaussians, anchor, moved, config, segmenter, key)  # gaussians: as at the anchor
method = Parts(config)
problem, run = method.start(sequence, start)
for now in drive(method, problem, run): ...
now.result.weights, now.result.poses(t), now.result.joints()

config.py    what can be set              method.py     what the loop has to know
anchor.py    which frame is canonical     pictures.py   what steps see
masks.py     what moves in every view     stream.py     one step of a frame
lift.py      from masks to Gaussians      refine.py     one step of all frames together
weights.py   the field of weights         update.py     the two as one step
discover.py  all that, before any motion  discovery.py  from frame to frame; parts become one or two
unify.py     which parts are one          finish.py     what no picture needs is given up
joints.py    what explains a motion       result.py     the outcome, which edits work on
"""

from gsjax.methods.parts.anchor import Anchor, choose_anchor, moved_pixels
from gsjax.methods.parts.config import (
    DiscoverConfig,
    PartsConfig,
    RefineConfig,
    StreamConfig,
    UnifyConfig,
)
from gsjax.methods.parts.discover import Start, begin
from gsjax.methods.parts.discovery import Discovery, order_of_frames
from gsjax.methods.parts.finish import outcome, without_needless
from gsjax.methods.parts.joints import joints_of, motions_in_world
from gsjax.methods.parts.masks import masks_of_labels
from gsjax.methods.parts.method import Parts
from gsjax.methods.parts.pictures import Problem
from gsjax.methods.parts.refine import RefineBatch, RefineParams, refine_step
from gsjax.methods.parts.result import PartsResult
from gsjax.methods.parts.stream import (
    Canonical,
    PosedScene,
    StreamBatch,
    StreamParams,
    stream_loss,
    stream_step,
)
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
from gsjax.methods.parts.update import parts_step as step

__all__ = [
    "BACKGROUND",
    "Anchor",
    "Canonical",
    "DiscoverConfig",
    "Discovery",
    "Moment",
    "PartScene",
    "Parts",
    "PartsConfig",
    "PartsResult",
    "PosedScene",
    "Problem",
    "RefineBatch",
    "RefineConfig",
    "RefineParams",
    "Start",
    "StreamBatch",
    "StreamConfig",
    "StreamParams",
    "Trajectory",
    "UnifyConfig",
    "begin",
    "choose_anchor",
    "gaussians_at",
    "joints_of",
    "masks_of_labels",
    "moment",
    "motions_in_world",
    "moved_pixels",
    "order_of_frames",
    "outcome",
    "refine_step",
    "step",
    "still",
    "stream_loss",
    "stream_step",
    "trajectory_of",
    "without_needless",
]
