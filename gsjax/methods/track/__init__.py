"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation): from one view's mask.

    scene = start_scene(first, mask, mask_camera, config)
    for now in gsjax.track(scene, first, frames, config):
        now.result.gaussians()

    config.py     what can be set             scene.py     Gaussians with labels, the moving ones first
    shapes.py     known shapes, for no depth  first_fit.py start_scene: the scene at the first frame
    frames.py     the cameras tracked with    motion.py    a twist a group, a displacement a Gaussian
    layers.py     what moves, over a background that is drawn once
    points.py     pixels of the last frame and of a keyframe, centres
    align.py      Levenberg-Marquardt on points, nothing rendered
    reference.py  what an object has to look like
    lost.py       detection of lost objects   recover.py   where a lost object may be
    search.py     several starts, aligned
    matching.py   masked cross-correlation of templates (the paper's)
    refine.py     photometric refinement (the paper's), in the tiles of region.py
    plan.py       capacities of a step        state.py     what the step advances
    stages/       the six stages of a frame   grow.py      surfaces that come into view
    update.py     the step, and the first look
    budget.py     settings for a time limit   method.py    the tracker as one value
    features.py   features that ride along    query.py     which object a text means
"""

from gsjax.methods.track.config import (
    PRESETS,
    AlignConfig,
    GrowConfig,
    MatchConfig,
    RefineConfig,
    StartConfig,
    TrackConfig,
)
from gsjax.methods.track.features import (
    DistillState,
    FeatureBatch,
    distill_features,
    feature_distiller,
    project_features,
    render_features,
)
from gsjax.methods.track.first_fit import start_scene
from gsjax.methods.track.frames import FrameShape, shape_of
from gsjax.methods.track.grow import EMPTY, with_slots
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.method import PLAN, Kept, Track
from gsjax.methods.track.motion import Pose, first_pose, place
from gsjax.methods.track.plan import TrackPlan, plan_tracker
from gsjax.methods.track.query import Match, find_object
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.shapes import scene_from_shapes
from gsjax.methods.track.state import TrackBatch, Tracked, TrackState
from gsjax.methods.track.update import first_look
from gsjax.methods.track.update import track_step as step

__all__ = [
    "EMPTY",
    "PLAN",
    "PRESETS",
    "AlignConfig",
    "DistillState",
    "FeatureBatch",
    "FrameShape",
    "GrowConfig",
    "Kept",
    "Match",
    "MatchConfig",
    "Pose",
    "RefineConfig",
    "StartConfig",
    "Track",
    "TrackBatch",
    "TrackConfig",
    "TrackPlan",
    "TrackState",
    "Tracked",
    "TrackedScene",
    "distill_features",
    "feature_distiller",
    "find_object",
    "first_look",
    "first_pose",
    "place",
    "plan_tracker",
    "project_features",
    "render_features",
    "render_labels",
    "scene_from_shapes",
    "shape_of",
    "start_scene",
    "step",
    "with_slots",
]
