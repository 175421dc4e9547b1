"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation), from one view's mask.

    scene = start_scene(first, mask, mask_camera, config)
    for now in gsjax.track(scene, first, frames, config):
        now.result.gaussians()

    config.py    settings                    first_fit.py  the scene at the first frame
    scene.py     Gaussians with labels       shapes.py     the same without depth, from known shapes
    state.py     parameters, state, batch    update.py     the step, and the state after the first frame
    stages/      the six stages of a frame   method.py     the tracker as one value
    budget.py    settings for a time limit   features.py   features that move with the Gaussians

docs/architecture.md lists the files that the stages use, in the order of the data flow.
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
from gsjax.methods.track.grow import with_slots
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.method import PLAN, Kept, Track
from gsjax.methods.track.motion import Pose, first_pose, place
from gsjax.methods.track.plan import TrackPlan, plan_tracker
from gsjax.methods.track.query import Match, find_object
from gsjax.methods.track.scene import EMPTY, TrackedScene
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
