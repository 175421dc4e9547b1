"""Draws docs/images/grasping.jpg: five moments of one grasp, with the tracked Gaussians of the object.

MUJOCO_GL=egl .venv/bin/python -m docs.images.make_grasping
"""

from pathlib import Path

import cv2
import numpy as np

from experiments.grasping.conveyor import VIEWS
from experiments.grasping.grasping import Attempt, begun, draw_trial, world
from experiments.shared.panda import Cameras
from gsjax.viz.colors import PALETTE

SEED, CAMERA = 2, 0
MOMENTS = (0, 16, 29, 36, -1)  # control periods
SIZE = (640, 480)  # of a picture before it is cut; the tracker is given far smaller ones
CUT = (slice(60, 400), slice(150, 550))  # rows and columns


class Filmed(Attempt):
    """An attempt that draws every control period, with the tracked Gaussians of the object as dots."""

    def act(self, pose: np.ndarray, finger: float) -> None:
        super().act(pose, finger)
        picture = np.ascontiguousarray(self.eyes.images(self.conveyor.data)[0][CAMERA])
        if finger > 0:  # the tracker looks until the fingers close
            viewmat, K = (np.asarray(a)[CAMERA] for a in (self.eyes.cameras.viewmat, self.eyes.cameras.K))
            to_camera = viewmat @ self.aim.grasp.pose @ np.linalg.inv(self.aim.held)
            local = self.start.body.points @ to_camera[:3, :3].T + to_camera[:3, 3]
            pixels = (local @ K.T)[:, :2] / local[:, 2:]
            for x, y in np.floor(pixels[::2]).astype(int):
                cv2.circle(picture, (int(x), int(y)), 1, PALETTE[0], -1, cv2.LINE_AA)
        self.pictures.append(picture[CUT])


def main() -> None:
    trial, first = draw_trial(SEED, moving=True), begun(SEED, True)
    world().begin(trial)
    attempt = Filmed(world(), trial, first, "tracker")
    attempt.eyes, attempt.pictures = Cameras(world().model, VIEWS, *SIZE, fovy=32.0), []
    print(attempt.run())
    chosen = [attempt.pictures[moment] for moment in MOMENTS]
    strip = np.concatenate([np.pad(c, ((0, 0), (0, 10), (0, 0)), constant_values=255) for c in chosen], 1)
    strip = cv2.resize(strip[:, :-10], None, fx=0.9, fy=0.9, interpolation=cv2.INTER_AREA)
    path = Path(__file__).with_name("grasping.jpg")
    cv2.imwrite(str(path), cv2.cvtColor(strip, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 90])


if __name__ == "__main__":
    main()
