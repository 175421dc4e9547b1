"""gsjax: moving scenes from 3D Gaussians, in pure JAX.

verbs       fit, track, parts, distill, deform: data in, a tick per step, `now.result` at the end
settings    FitConfig, TrackConfig, PartsConfig, DistillConfig, DeformConfig
data        open_photographs, open_sequence, Photographs, Sequence
tracking    start_scene, scene_from_shapes
files       save, load, open_scene, open_field, write_field, show, read_gaussians, write_gaussians, read_ply,
            write_ply
scene       Gaussians, Tags, Camera, Frame, render, plan_render
rasterize   rasterization, plan, Plan, sharded_rasterization, composite_tile
speed       host_options, keep_freed_memory, keep_programs
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gsjax.data import Photographs, Sequence, open_photographs, open_sequence
    from gsjax.engine.checkpoint import load, open_field, open_scene, save, write_field
    from gsjax.engine.show import show
    from gsjax.engine.verbs import deform, distill, fit, parts, track
    from gsjax.geometry.cameras import Camera
    from gsjax.io.ply import read_ply, write_ply
    from gsjax.io.scenes import read_gaussians, write_gaussians
    from gsjax.methods.deform import DeformConfig
    from gsjax.methods.distill import DistillConfig
    from gsjax.methods.fit import FitConfig
    from gsjax.methods.parts import PartsConfig
    from gsjax.methods.track import TrackConfig, scene_from_shapes, start_scene
    from gsjax.optim.compiler import host_options, keep_freed_memory, keep_programs
    from gsjax.rasterize.compositing import composite_tile
    from gsjax.rasterize.plan import Plan
    from gsjax.rasterize.rasterization import plan, rasterization
    from gsjax.rasterize.sharding import sharded_rasterization
    from gsjax.scene.frame import Frame
    from gsjax.scene.gaussians import Gaussians, Tags
    from gsjax.scene.render import plan_render, render

__version__ = "0.1.0"

# Loaded at first use (PEP 562): `gsjax --help` need not wait for JAX.
_HOMES = {
    "gsjax.data": ("Photographs", "Sequence", "open_photographs", "open_sequence"),
    "gsjax.engine.checkpoint": ("load", "open_field", "open_scene", "save", "write_field"),
    "gsjax.engine.show": ("show",),
    "gsjax.engine.verbs": ("deform", "distill", "fit", "parts", "track"),
    "gsjax.geometry.cameras": ("Camera",),
    "gsjax.io.ply": ("read_ply", "write_ply"),
    "gsjax.io.scenes": ("read_gaussians", "write_gaussians"),
    "gsjax.methods.deform": ("DeformConfig",),
    "gsjax.methods.distill": ("DistillConfig",),
    "gsjax.methods.fit": ("FitConfig",),
    "gsjax.methods.parts": ("PartsConfig",),
    "gsjax.methods.track": ("TrackConfig", "scene_from_shapes", "start_scene"),
    "gsjax.optim.compiler": ("host_options", "keep_freed_memory", "keep_programs"),
    "gsjax.rasterize.compositing": ("composite_tile",),
    "gsjax.rasterize.plan": ("Plan",),
    "gsjax.rasterize.rasterization": ("plan", "rasterization"),
    "gsjax.rasterize.sharding": ("sharded_rasterization",),
    "gsjax.scene.frame": ("Frame",),
    "gsjax.scene.gaussians": ("Gaussians", "Tags"),
    "gsjax.scene.render": ("plan_render", "render"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Camera",
    "DeformConfig",
    "DistillConfig",
    "FitConfig",
    "Frame",
    "Gaussians",
    "PartsConfig",
    "Photographs",
    "Plan",
    "Sequence",
    "Tags",
    "TrackConfig",
    "composite_tile",
    "deform",
    "distill",
    "fit",
    "host_options",
    "keep_freed_memory",
    "keep_programs",
    "load",
    "open_field",
    "open_photographs",
    "open_scene",
    "open_sequence",
    "parts",
    "plan",
    "plan_render",
    "rasterization",
    "read_gaussians",
    "read_ply",
    "render",
    "save",
    "scene_from_shapes",
    "sharded_rasterization",
    "show",
    "start_scene",
    "track",
    "write_field",
    "write_gaussians",
    "write_ply",
]


def __getattr__(name: str):
    if name not in _HOME_OF:
        raise AttributeError(f"module 'gsjax' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
