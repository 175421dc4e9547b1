"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation): from one view's mask.

docs/architecture.md has the files in the order in which the data flows.
"""

from gsjax.methods.object_tracker.config import (
    PRESETS,
    AlignConfig,
    GrowConfig,
    MatchConfig,
    RefineConfig,
    StartConfig,
    TrackerConfig,
)
from gsjax.methods.object_tracker.features import (
    DistillState,
    FeatureBatch,
    distill_features,
    feature_distiller,
    project_features,
    render_features,
)
from gsjax.methods.object_tracker.grow import EMPTY, with_slots
from gsjax.methods.object_tracker.layers import render_labels
from gsjax.methods.object_tracker.motion import Pose, first_pose, place
from gsjax.methods.object_tracker.plan import TrackerPlan, plan_tracker
from gsjax.methods.object_tracker.query import Match, find_object
from gsjax.methods.object_tracker.scene import TrackedScene
from gsjax.methods.object_tracker.shapes import scene_from_shapes
from gsjax.methods.object_tracker.tracker import TrackerBatch, TrackerState, object_tracker
from gsjax.methods.object_tracker.tracking import Tracked, first_state, start_scene, track

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
    "Tracked",
    "TrackedScene",
    "TrackerBatch",
    "TrackerConfig",
    "TrackerPlan",
    "TrackerState",
    "distill_features",
    "feature_distiller",
    "find_object",
    "first_pose",
    "first_state",
    "object_tracker",
    "place",
    "plan_tracker",
    "project_features",
    "render_features",
    "render_labels",
    "scene_from_shapes",
    "start_scene",
    "track",
    "with_slots",
]
