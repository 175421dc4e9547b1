"""gsjax: moving scenes from 3D Gaussians, in pure JAX.

    rasterize   rasterization, plan, Plan, composite_tile
    scene       Gaussians, Tags, Camera, Frame, render, plan_render
    data        open_sequence, Sequence
    tracking    start_scene, track, object_tracker, TrackerConfig
    files       read_ply, write_ply
"""

from gsjax.data import Sequence, open_sequence
from gsjax.geometry.cameras import Camera
from gsjax.io.ply import read_ply, write_ply
from gsjax.methods.object_tracker import TrackerConfig, object_tracker, start_scene, track
from gsjax.rasterize.compositing import composite_tile
from gsjax.rasterize.plan import Plan
from gsjax.rasterize.rasterization import plan, rasterization
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians, Tags
from gsjax.scene.render import plan_render, render

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Frame",
    "Gaussians",
    "Plan",
    "Sequence",
    "Tags",
    "TrackerConfig",
    "composite_tile",
    "object_tracker",
    "open_sequence",
    "plan",
    "plan_render",
    "rasterization",
    "read_ply",
    "render",
    "start_scene",
    "track",
    "write_ply",
]
