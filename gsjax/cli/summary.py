"""A run in words: the tables at the end of the terminal, and the same on the report's page."""

import os
import platform
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table as Grid

from gsjax.cli.report import Media, Table, format_number, write_report
from gsjax.cli.run_folder import RunFolder

OBJECT_COLUMNS = (
    ("centroid error", "centroid_error_mm", "mm"),
    ("point error", "point_error_mm", "mm"),
    ("median", "median_point_error_mm", "mm"),
    ("moved", "moved_mm", "mm"),
    ("turned", "turned_deg", "°"),
)
CAMERA_COLUMNS = (
    ("PSNR", "psnr", "dB"),
    ("SSIM", "ssim", ""),
    ("depth error", "depth_error_mm", "mm"),
    ("drawn", "coverage", ""),
    ("PSNR of it", "psnr_covered", "dB"),
    ("PSNR robot", "psnr_robot", "dB"),
)
TIMES = (
    ("preparing", "opening the recording, the first mask"),
    ("start", "first frame to a fitted scene"),
    ("compile", "compiling the update, once a plan"),
    ("updates", "updates: what a robot would wait for"),
    ("loading", "waiting for images"),
    ("loop_rest", "the rest of the loop"),
    ("loop_wall", "the loop, all together"),
    ("evaluation", "rendering, scoring and videos, after tracking"),
    ("total", "all of it"),
)


def machine() -> dict[str, Any]:
    """What ran it: processor, cores, and JAX's device. No name that someone gave it."""
    cpu, info = platform.processor() or platform.machine(), Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        cpu = names[0] if names else cpu
    devices = jax.devices()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": cpu,
        "cores": cores,
        "device": devices[0].device_kind,
        "devices": len(devices),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def object_rows(found: dict[str, Any]) -> list[list[Any]]:
    """One row an object: name, pixels, Gaussians, the columns above, IoU tracked and held out."""
    return [
        [
            name,
            *(scored[key] for _, key, _ in OBJECT_COLUMNS),
            found["iou"].get(name),
            found["iou_held_out"].get(name),
            scored["mask_pixels"],
            scored["gaussians"],
        ]
        for name, scored in found["objects"].items()
    ]


def camera_rows(found: dict[str, Any]) -> list[list[Any]]:
    """One row a camera."""
    return [
        [
            camera,
            "tracked" if scored["tracked"] else "held out",
            *(scored[key] for _, key, _ in CAMERA_COLUMNS),
        ]
        for camera, scored in found["cameras"].items()
    ]


_OBJECT_HEADS = ("object", *(n for n, _, _ in OBJECT_COLUMNS), "IoU", "IoU held out", "mask", "Gaussians")
_OBJECT_UNITS = ("", *(u for _, _, u in OBJECT_COLUMNS), "", "", "pixels", "")
_CAMERA_HEADS = ("camera", "", *(n for n, _, _ in CAMERA_COLUMNS))
_CAMERA_UNITS = ("", "", *(u for _, _, u in CAMERA_COLUMNS))


def print_summary(folder: RunFolder, found: dict[str, Any]) -> None:
    """Print objects, cameras, the rate and where the report is, to stdout."""
    console = Console(highlight=False)
    console.print()
    console.print(_grid(_OBJECT_HEADS, _OBJECT_UNITS, object_rows(found)))
    console.print(_grid(_CAMERA_HEADS, _CAMERA_UNITS, camera_rows(found)))
    frames, rate = found["frames"], found["update_hz"]
    speed = (
        "no updates" if rate is None else f"{rate:.2f} Hz ({found['update_ms']['median']:.0f} ms an update)"
    )
    console.print(f"[bold]{frames['tracked']}[/] of {frames['asked']} frames at [bold]{speed}[/]")
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)


def _grid(heads: tuple[str, ...], units: tuple[str, ...], rows: list[list[Any]]) -> Grid:
    """A table without the columns in which nothing stands."""
    shown = [i for i in range(len(heads)) if any(row[i] is not None for row in rows)]
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for i in shown:
        text = any(isinstance(row[i], str) for row in rows)
        unit = f"[dim]{units[i]}[/]" if units[i] else ""
        grid.add_column(f"{heads[i]}\n{unit}" if unit else heads[i], justify="left" if text else "right")
    for row in rows:
        grid.add_row(*(format_number(row[i]) for i in shown))
    grid.add_row()
    return grid


def write_run_report(
    folder: RunFolder, found: dict[str, Any], plots: list[tuple[Path, str]], first_mask: Path | None
) -> None:
    """Writes report.html."""
    frames, cameras = found["frames"], found["cameras"]
    size = f"{found['image']['width']}×{found['image']['height']}"
    subtitle = (
        f"Object-aware tracker on frames {frames['first_id']} to {frames['last_id']} ({frames['tracked']} of "
        f"{frames['asked']} asked for), {size}, cameras {_listed(found['tracked_cameras'])}"
    )
    if found["held_out_cameras"]:
        subtitle += f"; held out: {_listed(found['held_out_cameras'])}"
    partial = "" if found["complete"] else " (partial run)"
    machine = found["machine"]
    ran = (
        f"Machine: {machine['processor']}, {machine['cores']} cores; JAX {machine['jax']} on "
        f"{machine['devices']} × {machine['device']}."
    )
    write_report(
        folder.report,
        title=found["dataset"] + partial,
        subtitle=subtitle,
        summary=_headline(found),
        videos=[
            Media(folder.video(camera), f"Camera {camera}, {'tracked' if scored['tracked'] else 'held out'}")
            for camera, scored in cameras.items()
        ],
        plots=[Media(path, caption) for path, caption in plots],
        images=[
            Media(first_mask, f"The only mask that was seen: camera {found['mask']['camera']}, first frame")
        ]
        if first_mask
        else [],
        tables=[
            _table("Objects", _OBJECT_HEADS, _OBJECT_UNITS, object_rows(found), _OBJECT_NOTE),
            _table("Cameras", _CAMERA_HEADS, _CAMERA_UNITS, camera_rows(found), _CAMERA_NOTE),
            Table(
                "Time",
                ("part", "", "seconds"),
                [[name, says, found["seconds"].get(name)] for name, says in TIMES],
                note="Updates count from images in memory to the new state; the loop is compiling, updates, "
                "waiting and the rest.",
            ),
        ],
        notes=[*found["notes"], ran],
    )


_OBJECT_NOTE = (
    "Errors are means over frames and Gaussians against the true motion; IoU pools pixels over frames and "
    "cameras. Pixels are those of the first mask."
)
_CAMERA_NOTE = "PSNR and SSIM are over whole pictures; 'drawn' is the share of pixels that the scene covers."


def _headline(found: dict[str, Any]) -> dict[str, Any]:
    moved = [
        s for s in found["objects"].values() if s["centroid_error_mm"] is not None and s["moved_mm"] > 30
    ]
    cards: dict[str, Any] = {"Update rate": (found["update_hz"], "Hz")}
    if moved:
        worst = max(scored["centroid_error_mm"] for scored in moved)
        cards["Worst centroid error of what moved"] = (worst, "mm")
    if found["iou"]:
        cards["Least label IoU"] = min(v for v in found["iou"].values())
    cards["PSNR, tracked cameras"] = (found["tracked"]["psnr"], "dB")
    if found["held_out"]["psnr"] is not None:
        cards["PSNR, held out"] = (found["held_out"]["psnr"], "dB")
    return cards | {"Gaussians": found["gaussians"]["all"], "Frames": found["frames"]["tracked"]}


def _table(title: str, heads: tuple[str, ...], units: tuple[str, ...], rows: list, note: str) -> Table:
    """A table without the columns in which nothing stands."""
    shown = [i for i in range(len(heads)) if any(row[i] is not None for row in rows)] or [0]
    return Table(
        title,
        [heads[i] for i in shown],
        [[row[i] for i in shown] for row in rows],
        [units[i] for i in shown],
        note,
    )


def _listed(numbers: list[int]) -> str:
    return (
        " and ".join([", ".join(map(str, numbers[:-1])), str(numbers[-1])])
        if len(numbers) > 1
        else str(*numbers)
    )
