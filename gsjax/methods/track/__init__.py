"""The object-aware tracker (Object-Aware Gaussian Splatting for Robotic Manipulation).

A first RGB-D frame and the mask of one camera become a scene of labelled Gaussians, whose objects are then
tracked from frame to frame:

scene = start_scene(first, mask, mask_camera, config)
for now in gsjax.track(scene, first, frames, config):
    now.result.gaussians()

The modules, in the order in which data flows through them:

config.py     settings
scene.py      Gaussians with labels, the moving ones first
first_fit.py  the scene at the first frame; shapes.py: the same without depth, from known shapes
state.py      parameters, state and batch of the step; plan.py: its capacities
frames.py     preparation of a frame
update.py     the step, whose six stages are in stages/
motion.py     twists of groups, displacements of Gaussians
layers.py     moving Gaussians over a background that is rendered once
points.py     the points to align: pixels of the last frame and of a keyframe, centres of Gaussians
align.py      Levenberg-Marquardt on points, without rendering
search.py     alignment from several starts, of which the best is kept
matching.py   template matching by masked cross-correlation (the paper's)
refine.py     photometric refinement (the paper's), in the tiles of region.py
reference.py  the Gaussians labelled by the first mask, which define what an object looks like
watch.py      the record of each object: its usual residual, whether it is lost or was found again
lost.py       detection of lost objects; recover.py: their relocation
grow.py       growth of objects by surfaces that come into view
method.py     the tracker as a method; budget.py: choice of settings for a time budget
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
