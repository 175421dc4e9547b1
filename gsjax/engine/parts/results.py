"""The files of a run of `gsjax parts`: parts.npz, videos, scores, joints, the report."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gsjax.engine.ending import ended
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.machine import in_words
from gsjax.engine.messages import Notes, counted, reason
from gsjax.engine.parts.loop import update_seconds
from gsjax.engine.parts.scoring import part_rows, score_parts
from gsjax.engine.parts.views import part_views
from gsjax.engine.pictures import Film
from gsjax.engine.progress import Progress
from gsjax.engine.recording import Recording
from gsjax.engine.report import Media, format_number, write_report
from gsjax.engine.scores import CAMERA_COLUMNS, Scores, camera_metrics, camera_rows
from gsjax.engine.tables import Column, grid, table, time_table
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.io.atomic import write_npz
from gsjax.io.ply import write_ply
from gsjax.methods.parts import PartScene, PartsResult, Start, Trajectory
from gsjax.optim.method import Run
from gsjax.viz.colors import label_color

PART_COLUMNS = (
    Column("part", "name"),
    Column("true part", "true_name"),
    Column("Gaussians", "gaussians"),
    Column("moved", "moved_mm", "mm", 0),
    Column("joint", "kind"),
    Column("opens", "range", "° or mm", 0),
    Column("sure", "confidence", "%", 0),
    Column("axis off", "axis_deg", "°", 1),
    Column("hinge off", "line_mm", "mm", 1),
    Column("value off", "value", "° or mm", 1),
    Column("points off", "point_error_mm", "mm", 1),
    Column("median", "median_point_error_mm", "mm", 1),
    Column("IoU", "iou", "", 2),
)
_WIDE = ("gaussians", "line_mm", "point_error_mm", "iou")  # what 80 columns have no room for
_WIDE_ENOUGH = 130
_JOINTS = {"revolute": "hinge", "prismatic": "slide", "fixed": "none", "free": "free"}
_PART_NOTE = (
    "Colours are those of the videos. Joints are fitted to the motion since the canonical frame, in the "
    "world. 'Off' is against the true part that most of the Gaussians are of; points off is over the "
    "Gaussians that are truly of it, whatever part they were given to. 'Sure' is how far the motion is from "
    "where the joint would be called another, or the part free; of a free part, from where it would be on a "
    "joint."
)


def finished(
    folder: RunFolder,
    recording: Recording,
    start: Start,
    run: Run,
    found: PartsResult,
    progress: Progress,
    seconds: dict[str, float],
    notes: Notes,
    console: Console,
) -> dict[str, Any]:
    """Writes parts.npz, scene.ply and videos, and returns what metrics.json holds but for notes.

    Args:
        folder: of the run.
        recording: its tracked cameras, and those that are only judged.
        start: the canonical scene.
        run: of the method, after its last step.
        found: what it has come to.
        progress: how that went.
        seconds: by stage, so far.
        notes: receive what is odd.
        console: shows how far it is.
    """
    frames, kept = np.flatnonzero(found.done), run.kept
    stopped, scene, trajectory = progress.stopped, found.scene, found.trajectory
    complete = stopped is None
    if stopped is not None:
        why = reason(stopped).rstrip(".")
        notes.add(f"This run is not complete: it was stopped after {len(frames)} frames by {why}.")
    write_parts(folder.path / "parts.npz", scene, trajectory, found.anchor)
    write_ply(folder.scene, scene.gaussians, labels=np.asarray(scene.labels))
    joints, scores = found.joints(), Scores(None, None)
    if complete:
        colors = np.arange(scene.num_parts)
        try:
            with (
                Film(folder, recording, recording.tracked.num_frames, colors) as film,
                console.status("") as status,
            ):
                for frame in part_views(scene, trajectory, recording, found.blend):
                    status.update(f"rendering and scoring frame {frame[0].t + 1} of {len(frames)}")
                    for view in frame:
                        scores.add(view)
                        film.add(view)
        except (KeyboardInterrupt, OSError) as error:
            notes.warn(f"scoring was stopped after {scores.num_frames} frames by {reason(error)}")
            progress.stopped = error if isinstance(error, KeyboardInterrupt) else None
    rows, against_truth = part_rows(scene, trajectory, joints), {}
    if complete:
        against_truth = score_parts(
            scene, trajectory, joints, rows, recording, found.anchor, found.blend, notes
        )
    sequence, update_s = recording.tracked, update_seconds(progress)
    return {
        "kind": "parts",
        "dataset": sequence.name,
        **ended(progress.stopped),
        "anchor": found.anchor,
        "steps": run.step,
        "frames": {
            "followed": len(frames),
            "asked": sequence.num_frames,
            "first_id": sequence.frame_ids[0],
            "last_id": sequence.frame_ids[-1],
        },
        "image": {"width": sequence.width, "height": sequence.height},
        "tracked_cameras": list(sequence.camera_ids),
        "held_out_cameras": list(recording.held_out),
        "num_gaussians": scene.gaussians.num,
        "movable": kept.canonical.movable.num,
        "num_parts": scene.num_parts - 1,
        "pieces": int(start.masks.max()),
        "joined": kept.joined,
        "divided": kept.divided,
        "skipped": progress.skipped,
        "ari": against_truth.get("ari"),
        "true_parts": against_truth.get("true_parts"),
        "missed": against_truth.get("missed"),
        "parts": rows,
        **camera_metrics(scores),
        "update_s": {
            "median": float(np.median(update_s)) if update_s else None,
            "p95": float(np.percentile(update_s, 95)) if update_s else None,
        },
        "seconds": seconds,
        "curve": progress.rows,
        "machine": describe_machine(),
    }


def write_parts(path: Path, scene: PartScene, trajectory: Trajectory, anchor: int) -> None:
    """Writes parts.npz. A point x with weights w is at time t at sum_p w_p (R_p (x - c_p) + c_p + t_p); part
    0 is the background, which stands still. All in metres, seconds and the world's axes.

    anchor (frame index), means0 [N,3], weights [N,P], labels [N], centres [P,3], R [T,P,3,3], t [T,P,3],
    times [T].
    """
    arrays = {
        "anchor": np.array(anchor),
        "means0": scene.gaussians.means,
        "weights": scene.weights,
        "labels": scene.labels,
        "centres": scene.centers,
        "R": quats_to_matrices(trajectory.poses.quats),
        "t": trajectory.poses.translations,
        "times": trajectory.times,
    }
    write_npz(path, {name: np.asarray(array) for name, array in arrays.items()})


def write_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Writes report.html."""
    rows = _in_words(found["parts"])
    colors = [label_color(row["part"]) for row in rows]
    write_report(
        folder.report,
        title=found["dataset"] + ("" if found["complete"] else " (partial run)"),
        subtitle=(
            f"Parts found from motion (MotionSplicer); {found['frames']['followed']} frames, canonical "
            f"{found['anchor']}; {len(found['tracked_cameras'])} cameras, {found['image']['width']}×"
            f"{found['image']['height']}"
        ),
        summary=_headline(found),
        videos=[
            Media(
                folder.video(camera),
                f"Camera {camera}, {'looked through' if scored['tracked'] else 'held out'}",
            )
            for camera, scored in found["cameras"].items()
        ],
        tables=[
            *(replace(parts, colors=colors) for parts in table("Parts", PART_COLUMNS, rows, _PART_NOTE)),
            *table("Cameras", CAMERA_COLUMNS, camera_rows(found, "looked through"), ""),
            time_table(_TIMES, found["seconds"]),
        ],
        notes=[*_next_steps(folder, found), *found["notes"], f"Machine: {in_words(found['machine'])}."],
    )


def print_results(folder: RunFolder, found: dict[str, Any]) -> None:
    """Print parts, scores and where the report is, to stdout."""
    console = Console(highlight=False)
    console.print()
    if found["parts"]:
        wide = console.width >= _WIDE_ENOUGH
        columns = tuple(column for column in PART_COLUMNS if wide or column.key not in _WIDE)
        console.print(grid(columns, _in_words(found["parts"])))
    words = [f"[bold]{counted(found['num_parts'], 'part')}[/] of {counted(found['pieces'], 'piece')}"]
    if found["ari"] is not None:
        true = counted(found["true_parts"], "true part")
        words.append(f"adjusted Rand index [bold]{found['ari']:.3f}[/], {true}")
    console.print("; ".join(words))
    for kind, name in (("held_out", "held out"), ("tracked", "looked through")):
        if found[kind]["psnr"] is not None:
            console.print(f"[bold]{name}[/]  {found[kind]['psnr']:.2f} dB, SSIM {found[kind]['ssim']:.3f}")
    seconds, each = found["seconds"], found["update_s"]["median"]
    pace = f", {each:.1f} s a frame" if each else ""
    part = "" if found["complete"] else " [bold yellow](partial run)[/]"
    console.print(f"{found['frames']['followed']} frames in {seconds['total'] / 60:.1f} min{pace}{part}")
    console.print(f"[bold]report[/]  {folder.report}", soft_wrap=True)


def _in_words(parts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of parts, with joints called as people call them."""
    return [{**row, "kind": _JOINTS[row["kind"]]} for row in parts]


def _next_steps(folder: RunFolder, found: dict[str, Any]) -> list[str]:
    """What can be done with the parts that were found."""
    if not found["parts"] or found["frames"]["followed"] < 2:
        return []
    run = shlex.quote(str(folder.path))
    part = max(found["parts"], key=lambda row: row["moved_mm"])["part"]
    return [
        f"In space, and with a preview of edits: gsjax view {run}",
        f'A film of an edit: gsjax edit {run} --op "speed:parts={part},factor=2"',
    ]


def _headline(found: dict[str, Any]) -> dict[str, Any]:
    cards: dict[str, Any] = {"Parts": found["num_parts"]}
    if found["ari"] is not None:
        cards["Adjusted Rand index"] = format_number(found["ari"], 3)
    for kind, name in (("tracked", "PSNR"), ("held_out", "PSNR, held out")):
        if found[kind]["psnr"] is not None:
            cards[name] = (format_number(found[kind]["psnr"], 1), "dB")
    errors = [row["median_point_error_mm"] for row in found["parts"] if row.get("median_point_error_mm")]
    if errors:
        cards["Worst median point"] = (format_number(max(errors), 1), "mm")
    cards["Minutes"] = format_number(found["seconds"]["total"] / 60, 1)
    return cards | {"Gaussians": found["num_gaussians"]}


_TIMES = (
    ("canonical", "fitting the canonical scene, compiling included"),
    ("discovery", "finding what may move, compiling included"),
    ("updates", "following, frame by frame"),
    ("compile", "compiling that"),
    ("finish", "leaving out parts that no picture needs"),
    ("refine", "refining the scene over all frames, compiling included"),
    ("total", "all of it"),
)
