"""Makes docs/images/tracking.webp, the film of the README, out of a run of `make demo`.

.venv/bin/python docs/images/make_film.py runs/demo
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from gsjax.io.video import read_video_frames

CAMERA, GAP, HZ, QUALITY = 1, 4, 10, 60


def main(run: Path) -> None:
    frames = read_video_frames(run / f"video_{CAMERA}.mp4")
    height, width = frames.shape[1] // 2, frames.shape[2] // 2
    # A frame is 2 x 2: input and render above, error and labels below.
    panels = frames[:, :height, :width], frames[:, :height, width:], frames[:, height:, width:]
    white = np.full((len(frames), height, GAP, 3), 255, np.uint8)
    film = [
        Image.fromarray(one)
        for one in np.concatenate([panels[0], white, panels[1], white, panels[2]], axis=2)
    ]
    often = {"duration": round(1000 / HZ), "loop": 0, "quality": QUALITY, "method": 6}
    film[0].save(Path(__file__).with_name("tracking.webp"), save_all=True, append_images=film[1:], **often)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
