"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation): from one view's mask.

docs/architecture.md has the files in the order in which the data flows.
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
from gsjax.methods.track.grow import EMPTY, with_slots
from gsjax.methods.track.layers import render_labels
from gsjax.methods.track.motion import Pose, first_pose, place
from gsjax.methods.track.plan import TrackPlan, plan_tracker
from gsjax.methods.track.query import Match, find_object
from gsjax.methods.track.scene import TrackedScene
from gsjax.methods.track.shapes import scene_from_shapes
from gsjax.methods.track.tracking import Tracked, first_state, start_scene, track
from gsjax.methods.track.update import TrackBatch, TrackState, track_step

__all__ = [
    "EMPTY",
    "PRESETS",
    "AlignConfig",
    "DistillState",
    "FeatureBatch",
    "GrowConfig",
    "Match",
    "MatchConfig",
    "Pose",
    "RefineConfig",
    "StartConfig",
    "TrackBatch",
    "TrackConfig",
    "TrackPlan",
    "TrackState",
    "Tracked",
    "TrackedScene",
    "distill_features",
    "feature_distiller",
    "find_object",
    "first_pose",
    "first_state",
    "place",
    "plan_tracker",
    "project_features",
    "render_features",
    "render_labels",
    "scene_from_shapes",
    "start_scene",
    "track",
    "track_step",
    "with_slots",
]
