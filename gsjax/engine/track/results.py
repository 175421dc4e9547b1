"""A run in words: the tables at the end of the terminal, and the same on the report's page."""

from pathlib import Path
from typing import Any

from rich.console import Console

from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import in_words
from gsjax.engine.report import Media, format_number, write_report
from gsjax.engine.scores import CAMERA_COLUMNS, camera_rows
from gsjax.engine.tables import Column, grid, table, time_table

OBJECT_COLUMNS = (
    Column("object", "name"),
    Column("centroid error", "centroid_error_mm", "mm", 2),
    Column("point error", "point_error_mm", "mm", 2),
    Column("median", "median_point_error_mm", "mm", 2),
    Column("moved", "moved_mm", "mm", 1),
    Column("turned", "turned_deg", "°", 1),
    Column("travelled", "travelled_mm", "mm", 1),
    Column("lost", "frames_lost", "frames"),
    Column("IoU", "iou", "", 3),
    Column("IoU held out", "iou_held_out", "", 3),
    Column("mask", "mask_pixels", "pixels"),
    Column("Gaussians", "gaussians"),
)
TIMES = (
    ("preparing", "opening the recording, the first mask; drawing it if simulated"),
    ("start", "from the first frame to a fitted scene, compiling included"),
    ("planning", "loop: planning, before the first update"),
    ("compile", "loop: compiling the update, once a plan"),
    ("updates", "loop: updates, from images in memory to the new state"),
    ("loading", "loop: waiting for images"),
    ("loop_rest", "loop: the rest"),
    ("loop_wall", "loop, all together"),
    ("evaluation", "afterwards: rendering, scoring and videos"),
    ("total", "all of it"),
)
MOVED_MM = 30.0  # an object that moved less is no test of a tracker


def object_rows(found: dict[str, Any]) -> list[dict[str, Any]]:
    """One row an object, by the keys of `OBJECT_COLUMNS`."""
    return [
        {
            **scored,
            "name": name,
            "iou": found["iou"].get(name),
            "iou_held_out": found["iou_held_out"].get(name),
        }
        for name, scored in found["objects"].items()
    ]


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Print objects, cameras, the rate and where the report is, to stdout."""
    console = Console(highlight=False)
    console.print()
    scored = any(row["moved_mm"] is not None for row in object_rows(found))
    left_out = {"gaussians", "travelled_mm"} if scored else {"gaussians"}
    narrow = tuple(column for column in OBJECT_COLUMNS if column.key not in left_out)
    for columns, rows in ((narrow, object_rows(found)), (CAMERA_COLUMNS, camera_rows(found))):
        if rows:
            console.print(grid(columns, rows))
    for name, scored in found["objects"].items():
        if scored.get("turn_unknown_from") is not None:
            since = f"from frame {scored['turn_unknown_from']} on"
            console.print(f"{name}: how it is turned is not known {since}")
    frames, rate = found["frames"], found["update_hz"]
    speed = f"{rate:.2f} Hz ({found['update_ms']['mean']:.0f} ms an update)" if rate else "no updates"
    part = "" if found["complete"] else " [bold yellow](partial run)[/]"
    console.print(f"[bold]{frames['tracked']}[/] of {frames['asked']} frames, [bold]{speed}[/]{part}")
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)


def write_results(
    folder: RunFolder, found: dict[str, Any], plots: list[tuple[Path, str]], first_mask: Path | None
) -> None:
    """Writes report.html.

    Args:
        folder: of the run.
        found: what metrics.json holds.
        plots: files with their captions.
        first_mask: its picture, or None.
    """
    caption = f"Where objects come from: the first mask of camera {found['mask']['camera']}"
    write_report(
        folder.report,
        title=found["dataset"] + ("" if found["complete"] else " (partial run)"),
        subtitle=_subtitle(found),
        summary=_headline(found),
        videos=[
            Media(folder.video(camera), f"Camera {camera}, {'tracked' if scored['tracked'] else 'held out'}")
            for camera, scored in found["cameras"].items()
        ],
        plots=[Media(path, text) for path, text in plots],
        images=[Media(first_mask, caption)] if first_mask else [],
        tables=[
            *table("Objects", OBJECT_COLUMNS, object_rows(found), _OBJECT_NOTE),
            *table("Cameras", CAMERA_COLUMNS, camera_rows(found), _CAMERA_NOTE),
            time_table(TIMES, found["seconds"]),
        ],
        notes=[*found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


_OBJECT_NOTE = (
    "Errors are means over frames and Gaussians, against where the true motion would have carried each. IoU "
    "pools pixels over frames and cameras. 'Moved' is the truth's, 'travelled' the tracker's. "
    "Pixels are those of the first mask."
)
_CAMERA_NOTE = (
    "PSNR and SSIM are over whole pictures, black where the scene has nothing; 'drawn' is the part that it "
    "covers, and 'PSNR drawn' is over that part."
)


def _subtitle(found: dict[str, Any]) -> str:
    frames, image = found["frames"], found["image"]
    text = (
        f"Object-aware tracker; frames {frames['first_id']} to {frames['last_id']} ({frames['tracked']} of "
        f"{frames['asked']} asked for), {image['width']}×{image['height']}; "
        f"tracked with {_cameras(found['tracked_cameras'])}"
    )
    held_out = found["held_out_cameras"]
    return text + (f", judged by {_cameras(held_out)} too" if held_out else "")


def _headline(found: dict[str, Any]) -> dict[str, Any]:
    scored = [s for s in found["objects"].values() if s["centroid_error_mm"] is not None]
    moved = [s["centroid_error_mm"] for s in scored if s["moved_mm"] > MOVED_MM]
    cards: dict[str, Any] = {}
    if found["update_hz"]:
        cards["Update rate"] = (format_number(found["update_hz"], 2), "Hz")
    if moved:
        cards["Largest centroid error"] = (format_number(max(moved), 1), "mm")
    if found["iou"]:
        cards["Lowest label IoU"] = format_number(min(found["iou"].values()), 3)
    cards["PSNR, tracked"] = (format_number(found["tracked"]["psnr"], 1), "dB")
    if found["held_out"]["psnr"] is not None:
        cards["PSNR, held out"] = (format_number(found["held_out"]["psnr"], 1), "dB")
    return cards | {"Gaussians": found["gaussians"]["all"], "Frames": found["frames"]["tracked"]}


def _cameras(ids: list[int]) -> str:
    *front, last = map(str, ids)
    return f"cameras {', '.join(front)} and {last}" if front else f"camera {last}"
