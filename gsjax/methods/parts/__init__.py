"""Parts of a moving scene, discovered from their motion without annotation, and edited (MotionSplicer).

Masks of what moves are lifted to the Gaussians of one frame, the anchor, as candidate parts. The parts are
tracked from frame to frame, and joined or divided on the way; then the scene and the poses are refined over
all frames. The result is a scene with the trajectories of its parts, which edits transform.

anchor = choose_anchor(sequence.image, sequence.num_frames, sequence.num_cameras)
moved = moved_pixels(sequence.image, anchor, sequence.num_cameras)
start = begin(sequence, gaussians, anchor, moved, config, segmenter, key)  # the anchor's Gaussians
method = Parts(config)
problem, run = method.start(sequence, start)
for now in drive(method, problem, run): ...
now.result.weights, now.result.poses(t), now.result.joints()

config.py     settings                            method.py      the method, as `drive` runs it
anchor.py     the canonical frame                 pictures.py    the pictures that steps use
masks.py      masks in every view                 stream.py      the step of a frame
lift.py       from masks to Gaussians             refine.py      the step over all frames, and both as one
weights.py    the field of skinning weights       discovery.py   from frame to frame; joins and divides parts
discover.py   the start, from all of these        finish.py      removal of unneeded parts
unify.py      which parts join or divide          result.py      scene, trajectory and joints
motion.py     which Gaussians move and connect    exposure.py    colour correction of cameras
search.py     parts that jump                     absence.py     parts that leave, or appear later
sizes.py      sizes of pictures, and of a pixel
states/       parts from two states, with no frames in between
trajectory.py poses of parts over time            screws.py      poses as rigid motions
edits.py      edits of trajectories               film.py        layers rendered together
entries.py    validated entries of scripts        operation.py   base classes of operations
operations.py the operations of scripts           timeline.py    scripts, and the films that they make
limits.py     how far edits exceed what was seen  residual.py    the loss as residuals
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
from gsjax.methods.parts.finish import prune_parts, scene_and_trajectory
from gsjax.methods.parts.masks import masks_from_labels
from gsjax.methods.parts.method import Parts
from gsjax.methods.parts.pictures import Problem
from gsjax.methods.parts.refine import RefineBatch, RefineParams, refine_step
from gsjax.methods.parts.refine import parts_step as step
from gsjax.methods.parts.result import PartsResult, motions_in_world
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
    "masks_from_labels",
    "moment",
    "motions_in_world",
    "moved_pixels",
    "order_of_frames",
    "prune_parts",
    "refine_step",
    "scene_and_trajectory",
    "step",
    "still",
    "stream_loss",
    "stream_step",
    "trajectory_of",
]
