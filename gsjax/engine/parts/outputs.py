"""The files of a run of `gsjax parts`: parts.npz, scene.ply, videos, and the scores in metrics.json."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console

from gsjax.engine.ending import completion
from gsjax.engine.files import write_scene
from gsjax.engine.folder import RunFolder
from gsjax.engine.machine import describe as describe_machine
from gsjax.engine.messages import Notes, counted, reason
from gsjax.engine.parts.loop import update_seconds
from gsjax.engine.parts.scoring import part_rows, score_parts, warn_of_runaways
from gsjax.engine.parts.views import part_views
from gsjax.engine.pictures import Film
from gsjax.engine.progress import Progress
from gsjax.engine.recording import Recording
from gsjax.engine.scores import Scores, camera_metrics
from gsjax.geometry.rotations import quats_to_matrices
from gsjax.io.atomic import write_npz
from gsjax.methods.parts import PartScene, PartsResult, Start, Trajectory
from gsjax.optim.method import Run
from gsjax.scene.origin import in_world


def write_outputs(
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
    """Write parts.npz, scene.ply and videos, and return the contents of metrics.json except for its notes.

    Args:
        folder: of the run.
        recording: its tracked and held-out cameras.
        start: the canonical scene.
        run: the run after its last step.
        found: the result.
        progress: the progress of the run.
        seconds: time by stage, so far.
        notes: collects warnings.
        console: shows the progress.
    """
    frames, kept = np.flatnonzero(found.done), run.kept
    stopped, scene, trajectory = progress.stopped, found.scene, found.trajectory
    complete = stopped is None
    if stopped is not None:
        why = reason(stopped).rstrip(".")
        notes.add(f"This run is not complete: it was stopped after {counted(len(frames), 'frame')} by {why}.")
    origin = recording.tracked.origin
    write_parts(folder.path / "parts.npz", scene, trajectory, found.anchor, origin, recording.tracked.times)
    write_scene(folder.scene, scene.gaussians, np.asarray(scene.labels), origin=origin)
    joints, scores = found.joints(), Scores(None, None)
    if complete:
        film = Film(folder, recording, recording.tracked.num_frames, np.arange(scene.num_parts))
        views = part_views(scene, trajectory, recording, found.blend)
        try:
            film.score(views, scores, len(frames), console)
        except (KeyboardInterrupt, OSError) as error:
            notes.warn(f"scoring was stopped after {counted(scores.num_frames, 'frame')} by {reason(error)}")
            progress.stopped = error if isinstance(error, KeyboardInterrupt) else None
    rows, against_truth = part_rows(scene, trajectory, joints), {}
    _note_absences(trajectory, found.done, recording.tracked.frame_ids, notes)
    warn_of_runaways(rows, scene, notes)
    for row in rows if origin is not None else ():
        row["point"] = None if row["point"] is None else in_world(np.array(row["point"]), origin).tolist()
    if complete:
        against_truth = score_parts(
            scene, trajectory, joints, rows, recording, found.anchor, found.blend, notes
        )
    sequence, update_s = recording.tracked, update_seconds(progress)
    return {
        "kind": "parts",
        "dataset": sequence.name,
        **completion(progress.stopped),
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
        **progress.mishaps,
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


def _note_absences(
    trajectory: Trajectory, done: Bool[np.ndarray, "T"], frame_ids: Sequence[int], notes: Notes
) -> None:
    """Note which parts are absent in which frames, by their numbers in the data."""
    absent = (np.asarray(trajectory.opacities) == 0) & done[:, None]
    for part in np.flatnonzero(absent.any(0)).tolist():
        frames = np.flatnonzero(absent[:, part]).tolist()
        where = _runs(frames, frame_ids)
        notes.add(f"Part {part} is not there in {len(frames)} of {int(done.sum())} frames: {where}.")


def _runs(frames: list[int], frame_ids: Sequence[int]) -> str:
    """Frames as ranges of consecutive ones, by their numbers: "3 to 5, 9"."""
    ends = [t for t in frames if t + 1 not in frames]
    begins = [t for t in frames if t - 1 not in frames]
    numbers = ((frame_ids[a], frame_ids[b]) for a, b in zip(begins, ends, strict=True))
    return ", ".join(f"{a} to {b}" if b != a else f"{a}" for a, b in numbers)


def write_parts(
    path: Path,
    scene: PartScene,
    trajectory: Trajectory,
    anchor: int,
    origin: Float[np.ndarray, "3"] | None = None,
    times: Float[np.ndarray, "T"] | None = None,
) -> None:
    """Write parts.npz. At time t, a point x with weights w is at sum_p w_p (R_p (x - c_p) + c_p + t_p); part
    0 is the background, which does not move. All in metres, seconds and the world's axes.

    The arrays are anchor (frame index), means0 [N,3], weights [N,P], labels [N], centres [P,3],
    R [T,P,3,3], t [T,P,3] and times [T]. If a part is absent in a frame, there is also opacities [T,P]: 0
    where a part is absent, else 1; it multiplies the opacities of the part's Gaussians.

    Args:
        path: the file.
        scene, trajectory: the parts and their motion.
        anchor: index of the canonical frame.
        origin: what positions are relative to; it is added back.
        times: times of the frames in the data, float64 seconds (default: those of the trajectory, from 0).
    """
    arrays = {
        "anchor": np.array(anchor),
        "means0": in_world(np.asarray(scene.gaussians.means), origin),
        "weights": scene.weights,
        "labels": scene.labels,
        "centres": in_world(np.asarray(scene.centers), origin),
        "R": quats_to_matrices(trajectory.poses.quats),
        "t": trajectory.poses.translations,
        "times": trajectory.times if times is None else times,
    }
    if not (np.asarray(trajectory.opacities) == 1).all():
        arrays["opacities"] = trajectory.opacities
    write_npz(path, {name: np.asarray(array) for name, array in arrays.items()})
