"""A scene in a web browser: `open_viewer(Viewable("name", gaussians))`. Needs viser, which is imported late.

The browser draws splats in one colour; beside them stands our own rasterizer's picture from the same camera.
Files in the order in which the data flows: viewable (what is shown), pick, cameras, splats (what the browser
gets), drawing (our picture), newest (threads), words, splat_nodes and shot_nodes, edit_folder, ask_folder,
page, server.
"""

from gsjax.viz.viewer.pick import Picked, pick
from gsjax.viz.viewer.server import Viewer, open_viewer
from gsjax.viz.viewer.viewable import Asking, Editing, Found, Motion, Preview, Shots, Viewable, moved

__all__ = [
    "Asking",
    "Editing",
    "Found",
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
