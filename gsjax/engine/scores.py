"""Scores of views, accumulated one by one so that memory stays flat, and the metrics computed from them."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from gsjax.data import Sequence
from gsjax.engine.summary import Column
from gsjax.engine.views import View
from gsjax.metrics.image import depth_error, psnr, ssim
from gsjax.metrics.segmentation import LabelOverlap
from gsjax.metrics.tracking import ObjectScore, true_labels

SMALLEST_FOR_SSIM = 11
CAMERA_SCORES = (
    *("psnr", "ssim", "coverage", "psnr_covered", "depth_error_mm", "depth_within_1cm"),
    *("psnr_robot", "ssim_robot", "depth_error_robot_mm"),
)
CAMERA_COLUMNS = (
    Column("camera", "name"),
    Column("", "kind"),
    Column("PSNR", "psnr", "dB", 2),
    Column("SSIM", "ssim", "", 3),
    Column("depth error", "depth_error_mm", "mm", 1),
    Column("drawn", "coverage", "%", 1),
    Column("PSNR drawn", "psnr_covered", "dB", 2),
    Column("PSNR robot", "psnr_robot", "dB", 2),
)
CAMERA_NOTE = (
    "PSNR and SSIM are over whole pictures, black where the scene has nothing; 'drawn' is the part that it "
    "covers, and 'PSNR drawn' is over that part."
)


def mean_scores(rows: list[dict[str, Any]], names: Iterable[str]) -> dict[str, float | None]:
    """The mean of each score over the views for which it is finite; None if there are none."""
    known = {
        name: [row[name] for row in rows if row.get(name) is not None and np.isfinite(row[name])]
        for name in names
    }
    return {name: float(np.mean(values)) if values else None for name, values in known.items()}


@dataclass
class CameraScores:
    """Scores of one camera, one entry per frame; NaN where there was nothing to compare."""

    held_out: bool
    values: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def mean(self, name: str) -> float | None:
        """The mean over the frames with a finite score; None if there are none."""
        values = np.asarray(self.values.get(name, []), np.float64)
        values = values[np.isfinite(values)]
        return float(values.mean()) if len(values) else None


class Scores:
    """Scores of rendered pictures, depth and labels against what the cameras saw.

    Args:
        values: the mask value that each group of the scene stands for, [K+1]; None if labels are not scored.
        robot: the robot's mask value, or None.
    """

    def __init__(self, values: np.ndarray | None, robot: int | None):
        self._values, self._robot = values, robot
        self.cameras: dict[int, CameraScores] = {}
        self.overlaps = {False: LabelOverlap(), True: LabelOverlap()}
        self.num_frames = 0
        self.later_masks = {False: 0, True: 0}  # masks after the first frame, whose own may be input

    def add(self, view: View) -> None:
        """Score one view."""
        self.num_frames = max(self.num_frames, view.t + 1)
        camera = self.cameras.setdefault(view.camera, CameraScores(view.held_out))
        scored = {"psnr": psnr(view.render, view.image), "coverage": float(view.covered.mean())}
        scored["psnr_covered"] = psnr(view.render, view.image, view.covered)
        if min(view.image.shape[:2]) >= SMALLEST_FOR_SSIM:
            scored["ssim"] = ssim(view.render, view.image)
        if view.depth is not None:
            error = depth_error(view.render_depth, view.depth)
            scored |= {"depth_error_mm": error.mean_abs_mm, "depth_within_1cm": error.within_1cm}
        if view.mask is not None and self._robot is not None:
            inside = view.mask == self._robot
            scored["psnr_robot"] = psnr(view.render, view.image, inside)
            if "ssim" in scored:
                scored["ssim_robot"] = ssim(view.render, view.image, inside)
            if view.depth is not None:
                error = depth_error(view.render_depth, view.depth, inside)
                scored["depth_error_robot_mm"] = error.mean_abs_mm
        for name, value in scored.items():
            camera.values[name].append(value)
        if view.mask is not None and self._values is not None:
            self.overlaps[view.held_out].add(self._values[view.groups], view.mask)
            self.later_masks[view.held_out] += view.t > 0


def camera_metrics(scores: Scores) -> dict[str, Any]:
    """Each score's mean over frames, per camera, and over the tracked and the held-out cameras."""
    cameras = {
        str(camera): {"tracked": not found.held_out} | {name: found.mean(name) for name in CAMERA_SCORES}
        for camera, found in scores.cameras.items()
    }
    tracked = [found for found in cameras.values() if found["tracked"]]
    held_out = [found for found in cameras.values() if not found["tracked"]]
    return {
        "cameras": cameras,
        "tracked": mean_scores(tracked, CAMERA_SCORES),
        "held_out": mean_scores(held_out, CAMERA_SCORES),
    }


def camera_rows(found: dict[str, Any], seen: str = "tracked") -> list[dict[str, Any]]:
    """One row per camera, with the keys of `CAMERA_COLUMNS`. The kind of a camera that was not held out is
    `seen`."""
    return [
        {
            **scored,
            "name": camera,
            "kind": seen if scored["tracked"] else "held out",
            "coverage": None if scored["coverage"] is None else 100 * scored["coverage"],
        }
        for camera, scored in found["cameras"].items()
    ]


def motion_metrics(score: ObjectScore | None) -> dict[str, Any]:
    """The errors of one object for metrics.json; all None if it was not scored."""
    fields = ("centroid_error_mm", "point_error_mm", "median_point_error_mm", "moved_mm", "turned_deg")
    scored = {name: getattr(score, name, None) for name in fields}
    return scored | {"gaussians_scored": 0 if score is None else score.num_scored}


def true_labels_at(
    sequence: Sequence, t: int, points: Float[np.ndarray, "N 3"]
) -> Int[np.ndarray, "N"] | None:
    """The true label of each point, from the cameras that have a mask and depth of frame t; -1 where unknown.
    None if no camera has both.

    Args:
        sequence: with masks and depth.
        t: index of the frame.
        points: positions at that frame, world, metres.
    """
    cameras = range(sequence.num_cameras)
    seen = [
        (sequence.mask(t, c), sequence.depth(t, c), sequence.viewmats[t, c], sequence.Ks[t, c])
        for c in cameras
    ]
    seen = [one for one in seen if one[0] is not None and one[1] is not None]
    return true_labels(points, *zip(*seen, strict=True)) if seen else None
