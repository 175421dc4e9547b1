"""What a run writes: trajectory, scene, renders, videos, plots."""

import numpy as np
from jaxtyping import Bool

from gsjax.engine.folder import RunFolder
from gsjax.engine.recording import FirstMask, Recording
from gsjax.engine.scores import Scores
from gsjax.engine.summary import Media
from gsjax.engine.track.loop import Tracking
from gsjax.io.pictures import write_png
from gsjax.io.ply import write_ply
from gsjax.metrics.tracking import ObjectScore
from gsjax.viz import plots
from gsjax.viz.colors import overlay_labels


def write_tracking(folder: RunFolder, tracking: Tracking, times: np.ndarray) -> None:
    """Writes trajectory.npz and scene.ply; done before anything is scored, so that scoring may be stopped.

    Args:
        folder: of the run.
        tracking: the scene and its poses.
        times: [T] of the frames, seconds.
    """
    # Parts of one object are one label in the files.
    label_ids, label_of = np.unique(tracking.scene.label_ids, return_inverse=True)
    labels = label_of[np.asarray(tracking.scene.labels)].astype(np.int32)
    folder.write_trajectory(
        means=tracking.means().astype(np.float32),
        quats=tracking.quats().astype(np.float32),
        normals=np.asarray(tracking.scene.normals, np.float32),
        labels=labels,
        label_ids=label_ids.astype(np.int32),
        lost=_of_objects(tracking.lost, label_of),
        turn_known=~_of_objects([~known for known in tracking.turn_known], label_of),
        times=times[: tracking.num_frames],
        update_s=np.asarray(tracking.update_s),
    )
    write_ply(folder.scene, tracking.scene.gaussians, labels=labels)


def _of_objects(flags: list[np.ndarray], label_of: np.ndarray) -> Bool[np.ndarray, "T K"]:
    """Whether an update set the flag of any part of each object; none is set in the first frame."""
    rows = np.zeros((1 + len(flags), label_of.max()), bool)
    for t, row in enumerate(flags, 1):
        np.logical_or.at(rows[t], label_of[1:] - 1, row)
    return rows


def write_first_mask(folder: RunFolder, recording: Recording, mask: FirstMask) -> list[Media]:
    """Write a picture of the labels that tracking starts from, if there are any."""
    if mask.labels is None or mask.camera is None:
        return []
    image = recording.tracked.image(0, recording.tracked.camera_ids.index(mask.camera))
    path = folder.plot("first_mask", ".png")
    write_png(path, overlay_labels(image, mask.labels))
    return [Media(path, f"The first mask, of camera {mask.camera}, from which objects start")]


def write_plots(
    folder: RunFolder,
    tracking: Tracking,
    recording: Recording,
    scores: Scores,
    motion: dict[int, ObjectScore],
    names: dict[int, str],
    colors: np.ndarray,
) -> list[Media]:
    """Write the plots.

    Args:
        folder: of the run.
        tracking, recording: what was tracked, and what judges.
        scores: of views.
        motion: of objects, by mask value.
        names: of objects, by mask value.
        colors: [K+1], the label that gives each group its colour.
    """
    written = []

    def keep(name: str, figure, caption: str) -> None:
        written.append(Media(plots.save(figure, folder.plot(name)), caption))

    known = {names[label]: label for label in motion if label in names and motion[label].num_scored}
    if tracking.num_frames > 1:
        if known:
            errors = {name: motion[label].centroid_errors_mm for name, label in known.items()}
            figure = plots.error_over_frames(errors, known, limit_mm=5.0)
            keep("centroid_error", figure, "How far each object's centroid is from the truth")
        keep(
            "update_time",
            plots.update_time(np.array([np.nan, *tracking.update_s[1:]])),
            "Time of each update; compiling apart",
        )
    if scores.num_frames > 1:
        lines = {
            kind: {
                f"camera {camera}": np.asarray(found.values["psnr"])
                for camera, found in scores.cameras.items()
                if found.held_out == kind
            }
            for kind in (False, True)
        }
        keep(
            "psnr",
            plots.psnr_over_frames(lines[False], lines[True]),
            "Rendered pictures against the camera's",
        )
    if tracking.num_frames > 1:
        paths = _centroids(tracking, names, colors)
        caption = "Centroids from above; ring: start, dot: end; thin lines: the truth"
        figure = plots.trajectories(
            paths,
            {name: label for label, name in names.items()},
            _true_paths(recording, tracking, paths, names),
        )
        keep("paths", figure, caption)
    return written


def _centroids(tracking: Tracking, names: dict[int, str], colors: np.ndarray) -> dict[str, np.ndarray]:
    """Where the centroid of each object's Gaussians went, [T,3]."""
    groups, means = np.asarray(tracking.scene.labels), tracking.means()
    paths = {}
    for label, name in names.items():
        members = np.isin(groups, np.flatnonzero(colors == label))
        if members.any():
            paths[name] = means[:, members].mean(axis=1)
    return paths


def _true_paths(
    recording: Recording, tracking: Tracking, paths: dict[str, np.ndarray], names: dict[int, str]
) -> dict[str, np.ndarray]:
    """Where the truth would have carried the same centroids."""
    truth = recording.tracked.truth
    if truth is None:
        return {}
    true = {}
    for i, label in enumerate(truth.label_ids):
        name = names.get(int(label))
        if name in paths:
            poses = truth.poses[: tracking.num_frames, i]
            motion = poses @ np.linalg.inv(poses[0])
            true[name] = motion[:, :3, :3] @ paths[name][0] + motion[:, :3, 3]
    return true
