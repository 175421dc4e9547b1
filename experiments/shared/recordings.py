"""What experiments with the tracker share: recordings, their scenes, and the scores of `gsjax track`."""

import os
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from rich.console import Console

from gsjax.data import Sequence
from gsjax.engine.first_mask import FirstMask, first_mask
from gsjax.engine.recording import Recording, draw_ahead, open_recording
from gsjax.engine.scores import Scores
from gsjax.engine.track.loop import Tracking, begin, follow
from gsjax.engine.track.results import MOVED_MM
from gsjax.engine.track.scoring import first_labels, group_values, metrics, score_motion
from gsjax.engine.track.views import views
from gsjax.methods.track import StartConfig, TrackConfig, TrackedScene, start_scene
from gsjax.metrics.tracking import true_labels
from gsjax.scene.frame import Frame

DATA = Path(os.environ.get("GSJAX_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
MASK_CAMERA = 1
QUIET = Console(stderr=True, quiet=True)


class Start(NamedTuple):
    """A recording and the scene that the tracker starts from."""

    recording: Recording
    mask: FirstMask
    frame: Frame
    scene: TrackedScene


def labels_at(sequence: Sequence, points: Float[np.ndarray, "n 3"], t: int = 0) -> Int[np.ndarray, "n"]:
    """True labels of points in a frame, from the masks and depths of all cameras; -1 where unknown."""
    seen = [(sequence.mask(t, c), sequence.depth(t, c)) for c in range(sequence.num_cameras)]
    return true_labels(points, *zip(*seen, strict=True), list(sequence.viewmats[t]), list(sequence.Ks[t]))


def recorded(name: str) -> Path:
    """The folder of a recording that is not part of this repository."""
    if not (DATA / name).exists():
        raise FileNotFoundError(f"{DATA / name}: not there; set GSJAX_DATA to the folder that holds {name}")
    return DATA / name


@lru_cache(maxsize=4)
def started(
    dataset: str, frames: str, cameras: tuple[int, ...], held_out: tuple[int, ...], config: StartConfig
) -> Start:
    """The start of a recording, made once for several settings of the tracker."""
    jax.clear_caches()  # every scene has shapes of its own, and programs fill the process's memory map
    return start_of(open_recording(dataset, cameras, held_out, frames), TrackConfig(start=config))


def start_of(recording: Recording, config: TrackConfig) -> Start:
    """A recording and its scene at the first frame, from the mask of camera `MASK_CAMERA`."""
    draw_ahead(recording, QUIET)
    mask, frame = first_mask(recording.tracked, MASK_CAMERA, "files"), recording.tracked.frame(0)
    assert mask.labels is not None
    camera = recording.tracked.camera_ids.index(MASK_CAMERA)
    return Start(recording, mask, frame, start_scene(frame, mask.labels, camera, config))


def tracked(start: Start, config: TrackConfig) -> Tracking:
    """The whole recording tracked; an error that ends the loop is raised."""
    tracking = follow(begin(start.scene), start.frame, start.recording.tracked, config, QUIET)
    if tracking.stopped is not None:
        raise tracking.stopped
    return tracking


def scored(start: Start, tracking: Tracking, every: int = 1) -> dict[str, Any]:
    """Means over the objects that move; every n-th frame is compared as a picture and by its labels."""
    recording = start.recording
    values, truth = group_values(tracking, start.mask, recording), recording.tracked.truth
    scores = Scores(values, None if truth is None else truth.robot)
    for views_of_frame in views(tracking, recording, every):
        for view in views_of_frame:
            scores.add(view)
    labels = first_labels(tracking, recording)
    motion = score_motion(tracking, recording, labels)
    found = metrics(tracking, recording, start.mask, scores, motion, values, labels)
    moved = {name: s for name, s in found["objects"].items() if (s["moved_mm"] or 0) > MOVED_MM}
    centroids = {name: s["centroid_error_mm"] for name, s in moved.items()}
    return {
        "centroid_mm": np.mean(list(centroids.values())),
        "worst_centroid_mm": max(centroids.values()),
        "median_point_mm": np.mean([s["median_point_error_mm"] for s in moved.values()]),
        "worst_median_point_mm": max(s["median_point_error_mm"] for s in moved.values()),
        "mean_point_mm": np.mean([s["point_error_mm"] for s in moved.values()]),
        "iou": np.mean([found["iou"][name] for name in moved]),
        "held_out_psnr": found["held_out"]["psnr_covered"],
        "tracked_psnr": found["tracked"]["psnr"],
        "frames_lost": sum(s["frames_lost"] for s in moved.values()),
        "skipped": tracking.skipped,
        "objects": [f"{name}: {mm:.1f} mm" for name, mm in centroids.items()],
    }
