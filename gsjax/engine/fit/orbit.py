"""A video of the fitted scene, on a path around it."""

import numpy as np
from jaxtyping import Float

from gsjax.engine.fit.judge import Judge
from gsjax.engine.folder import RunFolder
from gsjax.geometry.cameras import Camera
from gsjax.geometry.paths import orbit
from gsjax.io.video import VideoWriter
from gsjax.scene.gaussians import Gaussians

NAME = "orbit"
FRAMES, _FPS, _LONGEST = 90, 30, 480


def write_orbit(
    folder: RunFolder,
    camera: Camera,
    viewmats: Float[np.ndarray, "n 4 4"],
    focus: Float[np.ndarray, "3"],
    gaussians: Gaussians,
    judge: Judge,
) -> None:
    """Write video_orbit.mp4: a loop of three seconds, at most 480 pixels wide or high.

    Args:
        folder: of the run.
        camera: gives the size of the pictures, and the field of view.
        viewmats: of the photographs, as refined by the fit.
        focus: centre of the path.
        gaussians: the scene.
        judge: renders it.
    """
    scale = min(1.0, _LONGEST / max(camera.height, camera.width))
    width, height = max(1, round(scale * camera.width)), max(1, round(scale * camera.height))
    K = np.diag([scale, scale, 1.0]) @ camera.K
    plan = None
    with VideoWriter(folder.video(NAME), _FPS) as video:
        for viewmat in orbit(viewmats, focus, FRAMES):
            placed = Camera(viewmat[None], K, width, height, camera.near)
            drawn, plan = judge.draw(gaussians, placed, plan)
            video.write(np.asarray(drawn.colors[0]))
