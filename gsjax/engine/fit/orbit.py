"""A video of the fitted scene, on a path about it."""

import jax.numpy as jnp
import numpy as np

from gsjax.engine.folder import RunFolder
from gsjax.geometry.cameras import Camera
from gsjax.geometry.paths import orbit
from gsjax.io.video import VideoWriter
from gsjax.methods.fit import Problem
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room

NAME = "orbit"
_FRAMES, _FPS, _LONGEST = 90, 30, 480


def write_orbit(folder: RunFolder, problem: Problem, gaussians: Gaussians) -> None:
    """Writes video_orbit.mp4: three seconds that can be repeated, at most 480 pixels wide or high."""
    view = problem.views[len(problem.views) // 2]
    height, width = view.image.shape[:2]
    scale = min(1.0, _LONGEST / max(height, width))
    width, height = max(1, round(scale * width)), max(1, round(scale * height))
    K = np.diag([scale, scale, 1.0]) @ view.K
    viewmats = orbit(np.stack([v.viewmat for v in problem.views]), problem.extent.focus, _FRAMES)
    behind = jnp.array([problem.background or (0.0, 0.0, 0.0)])
    mode, plan = "antialiased" if problem.config.antialiased else "classic", None
    with VideoWriter(folder.video(NAME), _FPS) as video:
        for viewmat in viewmats:
            placed = (jnp.asarray(a, jnp.float32)[None] for a in (viewmat, K))
            camera = Camera(*placed, width, height, view.near)
            drawn, plan = render_with_room(gaussians, camera, plan, backgrounds=behind, rasterize_mode=mode)
            video.write(np.asarray(drawn.colors[0]))
