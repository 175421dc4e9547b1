"""The summary of a run of `gsjax parts`: its parts, their joints, and their scores."""

import shlex
from collections.abc import Callable

from gsjax.engine.folder import RunFolder
from gsjax.engine.messages import counted
from gsjax.engine.scores import CAMERA_COLUMNS, CAMERA_NOTE, camera_rows, mean_scores
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


def _mean_of_parts(key: str) -> Callable[[Metrics], float | None]:
    return lambda found: mean_scores(found["parts"], (key,))[key]


SCORES = (
    Score("parts", "num_parts", "", None, None, at("num_parts")),
    Score("adjusted Rand index", "ari", "", 3, "more", at("ari")),
    Score("mean IoU", "iou", "", 3, "more", _mean_of_parts("iou")),
    Score("mean point error", "point_error_mm", "mm", 2, "less", _mean_of_parts("point_error_mm")),
    Score("PSNR", "psnr", "dB", 2, "more", at("tracked", "psnr")),
    Score("PSNR held out", "psnr_held_out", "dB", 2, "more", at("held_out", "psnr")),
    Score("SSIM held out", "ssim_held_out", "", 3, "more", at("held_out", "ssim")),
    Score("Gaussians", "num_gaussians", "", None, "less", at("num_gaussians")),
    Score("time of a frame", "update_s", "s", 2, "less", at("update_s", "median"), "machine"),
)
"""Means are over the parts whose ground truth is known."""
_PARTS = (
    Column("part", "name"),
    Column("true part", "true_name"),
    Column("Gaussians", "gaussians"),
    Column("moved", "moved_mm", "mm", 0),
    Column("joint", "kind"),
    Column("range", "range", "° or mm", 0),
    Column("confidence", "confidence", "%", 0),
    Column("axis error", "axis_deg", "°", 2),
    Column("hinge error", "line_mm", "mm", 2, wide=True),
    Column("value error", "value", "° or mm", 1),
    Column("point error", "point_error_mm", "mm", 1, wide=True),
    Column("median", "median_point_error_mm", "mm", 1),
    Column("IoU", "iou", "", 2, wide=True),
)
_JOINTS = {"revolute": "hinge", "prismatic": "slide", "fixed": "none", "free": "free"}
_TIMES = {
    "canonical": "fitting the canonical scene, compiling included",
    "discovery": "finding what may move, compiling included",
    "updates": "following, frame by frame",
    "compile": "compiling that",
    "finish": "removing parts that no picture needs",
    "refine": "refining the scene over all frames, compiling included",
    "total": "total",
}
_PART_NOTE = (
    "Colours are those of the videos. Joints are fitted to the motion since the canonical frame, in the "
    "world. Errors are against the true part that most of the Gaussians are of (without masks, the one that "
    "moves most alike). Point errors are over all frames and the Gaussians that are truly of it, whatever "
    "part they were given to (without masks, the frames that show the part and the Gaussians given to it). "
    "Confidence is how far the motion is from where the joint would be called another, or the part free; of "
    "a free part, from where it would be on a joint."
)


def summarize(folder: RunFolder, found: Metrics) -> Summary:
    """The summary of a run of `gsjax parts`."""
    frames, image = found["frames"], found["image"]
    cameras = camera_rows(found, "observed")
    return Summary(
        title=title_of(found["dataset"]),
        subtitle=(
            f"Parts found from motion (MotionSplicer), of {counted(found['pieces'], 'piece')}; "
            f"{counted(frames['followed'], 'frame')}, canonical {found['anchor']}; "
            f"{counted(len(found['tracked_cameras']), 'camera')}, "
            f"{image['width']}×{image['height']}; {found['seconds']['total'] / 60:.1f} min"
        ),
        cards=cards_of(SCORES, found),
        tables=[
            table_of_parts(found),
            Table("Cameras", CAMERA_COLUMNS, cameras, CAMERA_NOTE),
            time_table(_TIMES, found["seconds"]),
        ],
        videos=[Media(folder.video(row["name"]), f"Camera {row['name']}, {row['kind']}") for row in cameras],
        notes=found["notes"],
        machine=found["machine"],
        hints=_next_steps(folder, found),
        complete=found["complete"],
    )


def table_of_parts(found: Metrics) -> Table:
    """The parts of a run of `gsjax parts`, in the colours of its videos."""
    rows = [{**row, "kind": _JOINTS.get(row.get("kind"))} for row in found["parts"]]
    colors = [label_color(row["part"]) for row in rows]
    return Table("Parts", _PARTS, rows, _PART_NOTE, colors=colors, brief=True)


def _next_steps(folder: RunFolder, found: Metrics) -> list[tuple[str, str]]:
    """What can be done with the parts that were found."""
    if not found["parts"] or found["frames"]["followed"] < 2:
        return []
    run = shlex.quote(str(folder.path))
    return [
        ("view it, and edits of it", f"gsjax view {run}"),
        ("a film of an edit", example_edit(run, found)),
    ]


def example_edit(run: str, found: Metrics) -> str:
    """A command that edits the part of a run whose motion is most visible.

    Args:
        run: its folder, quoted for a shell.
        found: its metrics, with parts.
    """
    part = max(found["parts"], key=lambda row: row.get("gaussians", 0) * row.get("moved_mm", 0))["part"]
    fps = " --fps 15" if found["frames"]["followed"] == 2 else ""  # two states alone show no motion
    return f'gsjax edit {run} --op "speed:parts={part},factor=2"{fps}'
