"""Makes docs/images/tracking.jpg out of a run of `make demo`: three moments, as seen and as understood.

.venv/bin/python docs/images/make_picture.py runs/demo
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from gsjax.io.video import read_video_frames

CAMERA, MOMENTS, GAP = 1, 3, 6


def main(run: Path) -> None:
    panels = read_video_frames(run / f"video_{CAMERA}.mp4")
    height, width = panels.shape[1] // 2, panels.shape[2] // 2
    columns = []
    for t in np.linspace(0, len(panels) - 1, MOMENTS).round().astype(int):
        # A panel is 2 x 2: input and render above, error and labels below.
        parts = [panels[t, :height, :width], panels[t, :height, width:], panels[t, height:, width:]]
        columns.append(join(parts, axis=0))
    picture = join(columns, axis=1)
    path = Path(__file__).with_name("tracking.jpg")
    cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])


def join(parts: list[np.ndarray], axis: int) -> np.ndarray:
    """The parts beside each other with a white gap between them."""
    shape = list(parts[0].shape)
    shape[axis] = GAP
    white = np.full(shape, 255, np.uint8)
    spaced = [piece for part in parts for piece in (white, part)][1:]
    return np.concatenate(spaced, axis=axis)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
