"""The summary of a tracked recording: objects, cameras, the rate, videos and plots."""

from collections.abc import Sequence
from typing import Any

from gsjax.engine.folder import RunFolder
from gsjax.engine.scores import CAMERA_COLUMNS, CAMERA_NOTE, camera_rows
from gsjax.engine.summary import (
    Column,
    Media,
    Metrics,
    Score,
    Summary,
    Table,
    at,
    cards_of,
    time_table,
    title_of,
)
from gsjax.viz.colors import label_color

MOVED_MM = 30.0
"""An object that moved less does not test a tracker."""


def _worst_error(found: Metrics) -> float | None:
    """The centroid error, a mean over frames, of the worst object that moved far enough to tell."""
    errors = [
        scored["centroid_error_mm"]
        for scored in found["objects"].values()
        if scored["centroid_error_mm"] is not None and scored["moved_mm"] > MOVED_MM
    ]
    return max(errors, default=None)


def _lowest_auc(found: Metrics) -> float | None:
    """The area under the ADD-S curve of the worst object that moved far enough to tell, in per cent."""
    areas = [
        100 * scored["pose"]["add_s_auc"]
        for scored in found["objects"].values()
        if scored.get("pose") and scored["moved_mm"] is not None and scored["moved_mm"] > MOVED_MM
    ]
    return min(areas, default=None)


def _lowest_iou(found: Metrics) -> float | None:
    return min((value for value in found["iou"].values() if value is not None), default=None)


def _least_agreement(found: Metrics) -> float | None:
    """How much of what is seen of the worst object agrees with the pictures in its worst frame, per cent."""
    shares = [scored.get("agrees_least") for scored in found["objects"].values()]
    return min((100 * share for share in shares if share is not None), default=None)


SCORES = (
    Score("update rate", "update_hz", "Hz", 2, "more", at("update_hz"), "machine"),
    Score("mean centroid error, worst object", "centroid_error_mm", "mm", 2, "less", _worst_error),
    Score("lowest ADD-S AUC", "add_s_auc", "%", 1, "more", _lowest_auc),
    Score("lowest label IoU", "iou", "", 3, "more", _lowest_iou),
    Score("lowest agreement", "agrees", "%", 0, "more", _least_agreement),
    Score("PSNR", "psnr", "dB", 2, "more", at("tracked", "psnr")),
    Score("PSNR held out", "psnr_held_out", "dB", 2, "more", at("held_out", "psnr")),
    Score("SSIM held out", "ssim_held_out", "", 3, "more", at("held_out", "ssim")),
    Score("Gaussians", "num_gaussians", "", None, "less", at("gaussians", "all")),
    Score("frames", "frames", "", None, None, at("frames", "tracked")),
)
_OBJECTS = (
    Column("object", "name"),
    Column("label", "label", wide=True),
    Column("centroid error", "centroid_error_mm", "mm", 2),
    Column("point error", "point_error_mm", "mm", 2),
    Column("median", "median_point_error_mm", "mm", 2),
    Column("moved", "moved_mm", "mm", 1),
    Column("rotated", "turned_deg", "°", 1),
    Column("travelled", "travelled_mm", "mm", 1),
    Column("lost", "frames_lost", "frames"),
    Column("agrees, lowest", "agrees_least", "%", 0),
    Column("at the end", "agrees_last", "%", 0, wide=True),
    Column("ADD-S AUC", "add_s_auc", "%", 1, wide=True),
    Column("within 5 cm 5°", "recall_5cm_5deg", "%", 1, wide=True),
    Column("IoU", "iou", "", 3),
    Column("IoU held out", "iou_held_out", "", 3, wide=True),
    Column("mask", "mask_pixels", "pixels", wide=True),
    Column("Gaussians", "gaussians", wide=True),
)
_CAMERAS = (
    *CAMERA_COLUMNS,
    Column("PSNR first", "psnr_first", "dB", 2, wide=True),
    Column("last", "psnr_last", "dB", 2, wide=True),
)
_OBJECT_NOTE = (
    "Colours and labels are those of the videos. Errors are means over frames and Gaussians, against where "
    "the true motion would have carried each. IoU "
    "pools pixels over frames and cameras. 'Moved' is the truth's, 'travelled' the tracker's. "
    "'Agrees' is the share of what cameras see of the object, or of the worst part of it, that shows its "
    "colours and depth, in the worst frame: below 60 % look at the videos; below 25 to 35 % it counts as "
    "lost. "
    "Pixels are those of the first mask. 'ADD-S AUC' (up to 10 cm) and 'within 5 cm 5°' (of frames) are "
    "scores of pose benchmarks, from the true pose of the first frame on."
)
_AGREES = "agrees_least", "agrees_last"
_HOLES = (
    "What an object hid from all cameras in the first frame was never measured: there is a hole once it "
    "moves away."
)
_TIMES = {
    "preparing": "opening the recording, the first mask; drawing it if simulated",
    "start": "from the first frame to a fitted scene, compiling included",
    "planning": "loop: planning, looking at the first frame, trying settings for a budget",
    "compile": "loop: compiling, nearly all of it before the first update",
    "updates": "loop: updates, from images in memory to the new state",
    "loading": "loop: waiting for images",
    "loop_rest": "loop: the rest",
    "loop_wall": "loop, total",
    "evaluation": "afterwards: rendering, scoring and videos",
    "total": "total",
}


def summarize(folder: RunFolder, found: Metrics, plots: Sequence[Media], images: Sequence[Media]) -> Summary:
    """The summary of a tracked recording.

    Args:
        folder: of the run.
        found: its metrics.json.
        plots, images: those that the run has written.
    """
    rows = _object_rows(found)
    colors = [label_color(row["label"]) for row in rows]
    return Summary(
        title=title_of(found["dataset"]),
        resumable=(folder.resume / "state.npz").is_file(),
        subtitle=_subtitle(found),
        cards=cards_of(SCORES, found),
        tables=[
            Table("Objects", _OBJECTS, rows, _OBJECT_NOTE, colors=colors, brief=True),
            Table("Cameras", _CAMERAS, _camera_rows(found), f"{CAMERA_NOTE} {_HOLES}", brief=True),
            time_table(_TIMES, found["seconds"]),
        ],
        videos=[
            Media(folder.video(camera), f"Camera {camera}, {'tracked' if scored['tracked'] else 'held out'}")
            for camera, scored in found["cameras"].items()
        ],
        plots=plots,
        images=images,
        notes=found["notes"],
        machine=found["machine"],
        complete=found["complete"],
    )


def _object_rows(found: Metrics) -> list[dict[str, Any]]:
    """One row per object, by the keys of the columns."""
    return [
        {
            **scored,
            **{key: 100 * value for key, value in _shown_pose(scored).items()},
            **{key: 100 * scored[key] for key in _AGREES if scored.get(key) is not None},
            "name": name,
            "iou": found["iou"].get(name),
            "iou_held_out": found["iou_held_out"].get(name),
        }
        for name, scored in found["objects"].items()
    ]


def _camera_rows(found: Metrics) -> list[dict[str, Any]]:
    """One row per camera, with the PSNR of its first and of its last picture."""
    over_frames = found["over_frames"]["psnr"]
    return [
        row | {"psnr_first": over_frames[row["name"]][0], "psnr_last": over_frames[row["name"]][-1]}
        for row in camera_rows(found)
    ]


def _shown_pose(scored: Metrics) -> dict[str, float]:
    """The scores of an object's poses that the table shows, 0 to 1; none for runs that did not score them."""
    pose = scored.get("pose") or {}
    return {key: pose[key] for key in ("add_s_auc", "recall_5cm_5deg") if key in pose}


def _subtitle(found: Metrics) -> str:
    frames, image = found["frames"], found["image"]
    text = (
        f"Object-aware tracker; frames {frames['first_id']} to {frames['last_id']} "
        f"({frames['tracked']} of {frames['asked']} requested), {image['width']}×{image['height']}; "
        f"tracked with {_cameras(found['tracked_cameras'])}"
    )
    held_out = found["held_out_cameras"]
    return text + (f", {_cameras(held_out)} held out" if held_out else "")


def _cameras(ids: list[int]) -> str:
    *front, last = map(str, ids)
    return f"cameras {', '.join(front)} and {last}" if front else f"camera {last}"
