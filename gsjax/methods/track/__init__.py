"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation), from one view's mask.

scene = start_scene(first, mask, mask_camera, config)
for now in gsjax.track(scene, first, frames, config):
    now.result.gaussians()

What a frame goes through, in its order, and what each step is made of:

config.py     settings
scene.py      Gaussians with labels, the moving ones first
first_fit.py  the scene at frame one; shapes.py: the same without depth, from known shapes
state.py      parameters, state and batch of the step; plan.py: its capacities
frames.py     preparation of a frame
update.py     the step, whose six stages are in stages/
motion.py     twists of groups, displacements of Gaussians
layers.py     moving Gaussians over a background that is drawn once
points.py     the points that are aligned: pixels of the last frame and of a keyframe, centres
align.py      Levenberg-Marquardt on points, without rendering
search.py     several starts, aligned; the one that agrees best is kept
matching.py   masked cross-correlation of templates (the paper's)
refine.py     photometric refinement (the paper's), in the tiles of region.py
reference.py  the Gaussians that the first mask labelled: what an object has to look like
watch.py      the record of each object: what is usual, whether it is lost or was found
lost.py       detection of lost objects; recover.py: their relocation
grow.py       surfaces that come into view
method.py     the tracker as one value; budget.py: settings for a time limit
features.py   features that move with the Gaussians; query.py: language queries
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
