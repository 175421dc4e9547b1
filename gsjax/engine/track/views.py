"""Views of a tracked scene from each camera, frame by frame."""

from collections.abc import Iterator

from gsjax.engine.recording import Recording
from gsjax.engine.track.loop import Tracking
from gsjax.engine.views import View, views_of
from gsjax.methods.track import place, render_labels


def views(tracking: Tracking, recording: Recording, every: int = 1) -> Iterator[list[View]]:
    """The views of all cameras, a list for every n-th frame; one frame is in memory at a time.

    This opens the masks of all frames, for scoring: call it when tracking has ended.
    """
    return views_of(recording, range(0, tracking.num_frames, every), tracking.at, render_labels, place)
