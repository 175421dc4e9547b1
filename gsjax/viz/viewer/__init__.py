"""A scene in a web browser: `open_viewer(Viewable("name", gaussians))`. Needs viser, which is imported late.

The browser draws splats with view-independent colours; beside them is our rasterizer's picture from the same
camera. Files in the order in which the data flows: viewable (what is shown), pick, cameras, splats (what the
browser receives), drawing (our picture), debounce (threads), markup, splat_nodes and shot_nodes, edit_folder,
ask_folder, page, server.
"""

from gsjax.viz.viewer.pick import Picked, pick
from gsjax.viz.viewer.server import Viewer, open_viewer
from gsjax.viz.viewer.viewable import Answer, Asking, Editing, Motion, Preview, Shots, Viewable, moved

__all__ = [
    "Answer",
    "Asking",
    "Editing",
    "Motion",
    "Picked",
    "Preview",
    "Shots",
    "Viewable",
    "Viewer",
    "moved",
    "open_viewer",
    "pick",
]
