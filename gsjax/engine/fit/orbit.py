"""A video of the fitted scene, on a path about it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gsjax.engine.fit.judge import Judge
from gsjax.engine.folder import RunFolder
from gsjax.geometry.cameras import Camera, on_device
from gsjax.geometry.paths import orbit
from gsjax.io.video import VideoWriter
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room

NAME = "orbit"
_FRAMES, _FPS, _LONGEST = 90, 30, 480


def write_orbit(
    folder: RunFolder, frames: list[Frame], focus: Float[np.ndarray, "3"], gaussians: Gaussians, judge: Judge
) -> None:
    """Writes video_orbit.mp4: three seconds that can be repeated, at most 480 pixels wide or high.

    Args:
        folder: of the run.
        frames: the photographs, from where the fit found their cameras.
        focus: what the path goes about.
        gaussians: the scene.
        judge: how it is drawn.
    """
    camera = frames[len(frames) // 2].cameras
    scale = min(1.0, _LONGEST / max(camera.height, camera.width))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    K = np.diag([scale, scale, 1.0]) @ camera.K
    viewmats = orbit(np.concatenate([frame.cameras.viewmat for frame in frames]), focus, _FRAMES)
    behind = jnp.array([judge.background or (0.0, 0.0, 0.0)])
    mode, plan = "antialiased" if judge.config.antialiased else "classic", None
    with VideoWriter(folder.video(NAME), _FPS) as video:
        for viewmat in viewmats:
            placed = on_device(Camera(viewmat[None], K, width, height, camera.near))
            drawn, plan = render_with_room(gaussians, placed, plan, backgrounds=behind, rasterize_mode=mode)
            video.write(np.asarray(drawn.colors[0]))
