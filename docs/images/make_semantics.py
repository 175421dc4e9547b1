"""Makes docs/images/semantics.jpg out of a run: three moments from a held-out camera.

    .venv/bin/gsjax track "simulated:tabletop" --frames 0:37 --cameras 0 2 --mask-camera 0 --eval-cameras 1 \\
        --track.start.iterations 60 --out runs/semantics
    .venv/bin/gsjax grasp runs/semantics "blue can"
    .venv/bin/python docs/images/make_semantics.py runs/semantics
"""

import sys
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np

from gsjax.engine.track.saved import SavedRun, open_run
from gsjax.engine.track.views import views
from gsjax.io.video import read_video_frames
from gsjax.methods.track import distill_features, first_pose, render_features
from gsjax.perception.gabor import GaborEncoder
from gsjax.viz.colors import PcaColors, colorize_features, fit_pca_colors, overlay_labels, to_uint8

WIDTH, MOMENTS, GAP = 400, 3, 6
_BARE = 236  # where the scene was never seen


def main(run: Path) -> None:
    saved = open_run(run)
    recording = saved.seen_by(None)
    features, colors = _features(saved)
    grasps = read_video_frames(run / "grasp" / "video.mp4")
    moments = np.linspace(0, len(grasps) - 1, MOMENTS).round().astype(int).tolist()
    columns = []
    for frame in views(saved.tracking, recording):
        view = frame[0]
        if view.t not in moments:
            continue
        scene, pose = saved.tracking.at(view.t)
        drawn, alphas = render_features(scene, pose, features, recording.tracked.frame(view.t).cameras)
        picture = colorize_features(np.asarray(drawn[0]), colors)
        picture[np.asarray(alphas[0]) < 0.5] = _BARE
        groups = overlay_labels(to_uint8(view.image), view.groups)
        parts = [to_uint8(view.image), groups, picture, grasps[view.t]]
        columns.append(join([_sized(part) for part in parts], axis=0))
    path = Path(__file__).with_name("semantics.jpg")
    picture = join(columns, axis=1)
    cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])


def _features(saved: SavedRun) -> tuple[jnp.ndarray, PcaColors]:
    """Features of all Gaussians from the tracked cameras' first pictures, and their colours."""
    first, _ = saved.tracking.at(0)
    frame = saved.recording.tracked.frame(0)
    features = distill_features(first, frame, GaborEncoder()(np.asarray(frame.images)))
    drawn, alphas = render_features(first, first_pose(first), jnp.asarray(features), frame.cameras)
    return jnp.asarray(features), fit_pca_colors(np.asarray(drawn)[np.asarray(alphas) > 0.5])


def _sized(picture: np.ndarray) -> np.ndarray:
    height = round(WIDTH * picture.shape[0] / picture.shape[1])
    how = cv2.INTER_AREA if picture.shape[1] > WIDTH else cv2.INTER_CUBIC
    return cv2.resize(picture, (WIDTH, height), interpolation=how)


def join(parts: list[np.ndarray], axis: int) -> np.ndarray:
    """The parts beside each other with a white gap between them."""
    shape = list(parts[0].shape)
    shape[axis] = GAP
    white = np.full(shape, 255, np.uint8)
    return np.concatenate([piece for part in parts for piece in (white, part)][1:], axis=axis)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
