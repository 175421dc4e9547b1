"""Videos and pictures of a run's views."""

import contextlib

import numpy as np
from jaxtyping import Float

from gsjax.engine.folder import RunFolder
from gsjax.engine.recording import Recording
from gsjax.engine.views import View
from gsjax.io.pictures import write_png
from gsjax.io.video import VideoWriter
from gsjax.viz.colors import side_by_side, to_uint8

PANELS = ("photograph", "rendered", "difference")
"""What a picture of a view shows, from left to right."""
RENDERS = 5
"""Rendered pictures a camera that are kept as files, from the first frame to the last."""
MAX_VIDEO_HZ = 60.0
MIN_VIDEO_HZ = 1.0


def frame_rate(times: Float[np.ndarray, "t"]) -> float:
    """Frames a second of a video, near the recording's own."""
    steps = np.diff(times)
    return float(np.clip(1 / np.median(steps), MIN_VIDEO_HZ, MAX_VIDEO_HZ)) if len(steps) else MIN_VIDEO_HZ


class Film:
    """Writes each camera's video and a few of its renders as views go by: `with Film(...) as film`."""

    def __init__(self, folder: RunFolder, recording: Recording, num_frames: int, colors: np.ndarray):
        """
        Args:
            num_frames: how many will be shown.
            colors: the label that gives each group its colour, [K+1].
        """
        self._folder, self._frame_ids, self._colors = folder, recording.judged.frame_ids, colors
        self._kept = set(np.linspace(0, num_frames - 1, RENDERS).round().astype(int).tolist())
        self._fps = frame_rate(recording.judged.times)
        self._stack = contextlib.ExitStack()
        self._videos: dict[int, VideoWriter] = {}

    def add(self, view: View) -> None:
        """Append one view to its camera's video."""
        if view.camera not in self._videos:
            writer = VideoWriter(self._folder.video(view.camera), self._fps)
            self._videos[view.camera] = self._stack.enter_context(writer)
        panel = side_by_side(view.image, view.render, labels=self._colors[view.groups])
        self._videos[view.camera].write(panel)
        if view.t in self._kept:
            path = self._folder.render(view.camera, self._frame_ids[view.t])
            write_png(path, to_uint8(view.render))

    def __enter__(self) -> "Film":
        return self

    def __exit__(self, *exception) -> None:
        self._stack.__exit__(*exception)
