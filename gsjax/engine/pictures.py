"""Videos and pictures of a run's views."""

import contextlib
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num, UInt8
from rich.console import Console

from gsjax.engine.folder import RunFolder
from gsjax.engine.recording import Recording
from gsjax.engine.scores import Scores
from gsjax.engine.views import View
from gsjax.io.pictures import write_png
from gsjax.io.video import VideoWriter
from gsjax.viz.colors import highlight, side_by_side, to_uint8

PANELS = ("photograph", "rendered", "difference")
"""Captions of the panels of a view, from left to right."""
RENDERS = 5
"""Number of rendered pictures kept per camera, from the first frame to the last."""
MAX_VIDEO_HZ = 60.0
MIN_VIDEO_HZ = 1.0
MARK = (255, 70, 160)
"""RGB colour of the outline around what a query found."""
MIN_SHARE = 0.5
"""A pixel shows what was found if more than this share of its light comes from there."""
_VIDEO_HEIGHT = 480  # smaller pictures are enlarged


def frame_rate(times: Float[np.ndarray, "t"]) -> float:
    """Frames per second of a video, near the recording's own."""
    steps = np.diff(np.unique(times))  # photographs may share a time
    return float(np.clip(1 / np.median(steps), MIN_VIDEO_HZ, MAX_VIDEO_HZ)) if len(steps) else MIN_VIDEO_HZ


def spotlight(
    image: Num[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], color: tuple[int, int, int]
) -> UInt8[np.ndarray, "H W 3"]:
    """The image of a camera with what was found in its own colours and the rest dimmed; small images are
    enlarged.

    Args:
        image: uint8, or floats 0 to 1.
        mask: pixels of what was found.
        color: of its outline, RGB.
    """
    height, width = mask.shape
    factor = max(1, -(-_VIDEO_HEIGHT // height))
    size = (width * factor, height * factor)
    image = cv2.resize(to_uint8(image), size, interpolation=cv2.INTER_CUBIC)
    # For smooth outlines, interpolate the mask's share of each pixel and threshold that.
    soft = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_CUBIC)
    return highlight(image, soft > 0.5, color)


class Film:
    """Writes a video of each camera and a few of its renders: `with Film(...) as film: film.add(view)`."""

    def __init__(self, folder: RunFolder, recording: Recording, num_frames: int, labels: np.ndarray):
        """
        Args:
            folder: of the run.
            recording: the recording.
            num_frames: number of frames that will be added.
            labels: the label of each group, [K+1], which determines its colour.
        """
        self._folder, self._frame_ids, self._labels = folder, recording.judged.frame_ids, labels
        self._kept = set(np.linspace(0, num_frames - 1, RENDERS).round().astype(int).tolist())
        self._fps = frame_rate(recording.judged.times)
        self._stack = contextlib.ExitStack()
        self._videos: dict[int, VideoWriter] = {}

    def add(self, view: View) -> None:
        """Append one view to its camera's video."""
        if view.camera not in self._videos:
            writer = VideoWriter(self._folder.video(view.camera), self._fps)
            self._videos[view.camera] = self._stack.enter_context(writer)
        panel = side_by_side(view.image, view.render, labels=self._labels[view.groups])
        self._videos[view.camera].write(panel)
        if view.t in self._kept:
            path = self._folder.render(view.camera, self._frame_ids[view.t])
            write_png(path, to_uint8(view.render))

    def score(self, views: Iterable[list[View]], scores: Scores, num_frames: int, console: Console) -> None:
        """Score and film the views of all frames, each while the next is rendered, and close the videos.

        Args:
            views: those of all cameras, a list per frame.
            scores: collects the scores.
            num_frames: number of frames.
            console: shows the progress.
        """
        judged: Future[None] | None = None
        with self, console.status("") as status, ThreadPoolExecutor(1, "scoring") as worker:
            for frame in views:
                status.update(f"rendering and scoring frame {frame[0].t + 1} of {num_frames}")
                if judged is not None:
                    judged.result()
                judged = worker.submit(self._score, frame, scores)
            if judged is not None:
                judged.result()

    def _score(self, frame: list[View], scores: Scores) -> None:
        for view in frame:
            scores.add(view)
            self.add(view)

    def __enter__(self) -> "Film":
        return self

    def __exit__(self, *exception) -> None:
        self._stack.__exit__(*exception)
