"""Files of a tracked recording: trajectory, scene and plots."""

import numpy as np
from jaxtyping import Float, Int, Shaped

from gsjax.engine.files import write_scene
from gsjax.engine.first_mask import FirstMask
from gsjax.engine.folder import RunFolder
from gsjax.engine.recording import Recording
from gsjax.engine.scores import Scores
from gsjax.engine.summary import Media
from gsjax.engine.track.loop import Tracking
from gsjax.io.pictures import write_png
from gsjax.metrics.pose import fitted_poses
from gsjax.metrics.tracking import ObjectScore, relative_motion
from gsjax.scene.origin import in_world
from gsjax.viz import plots
from gsjax.viz.colors import overlay_labels


def write_tracking(
    folder: RunFolder, tracking: Tracking, times: np.ndarray, origin: Float[np.ndarray, "3"] | None = None
) -> None:
    """Write trajectory.npz and scene.ply; this precedes scoring, which may be interrupted.

    Args:
        folder: of the run.
        tracking: the scene and its poses.
        times: [T] of the frames, seconds.
        origin: what positions are relative to; it is added back, and means are then float64.
    """
    # Parts of one object are one label in the files.
    label_ids, label_of = np.unique(tracking.scene.label_ids, return_inverse=True)
    labels = label_of[np.asarray(tracking.scene.labels)].astype(np.int32)
    folder.write_trajectory(
        means=in_world(tracking.means().astype(np.float32), origin),
        quats=tracking.quats().astype(np.float32),
        normals=np.asarray(tracking.scene.normals, np.float32),
        labels=labels,
        label_ids=label_ids.astype(np.int32),
        poses=_poses_of(tracking, labels, origin),
        lost=_of_objects(tracking.lost, label_of, np.logical_or, False),
        turn_known=_of_objects(tracking.turn_known, label_of, np.logical_and, True),
        agrees=_of_objects(tracking.agrees, label_of, np.minimum, np.float32(1)),
        times=times[: tracking.num_frames],
        update_s=np.asarray(tracking.update_s),
    )
    write_scene(folder.scene, tracking.scene.gaussians, labels, origin=origin)


def _poses_of(
    tracking: Tracking, labels: Int[np.ndarray, "N"], origin: Float[np.ndarray, "3"] | None
) -> Float[np.ndarray, "T K 4 4"]:
    """The rigid motion of each object since the first frame, in the world; none for one without Gaussians."""
    means, count = tracking.means().astype(np.float64), len(np.unique(tracking.scene.label_ids)) - 1
    poses = np.tile(np.eye(4), (len(means), count, 1, 1))
    for k in range(count):
        mine = labels == k + 1
        if mine.any():
            poses[:, k] = fitted_poses(means[:, mine], np.eye(4))
    if origin is not None:  # x -> R (x - o) + t + o
        poses[..., :3, 3] += origin - poses[..., :3, :3] @ origin
    return poses


def _of_objects(
    values: list[np.ndarray], label_of: np.ndarray, joined: np.ufunc, first: bool | np.float32
) -> Shaped[np.ndarray, "T K"]:
    """The value of each object in each frame: those of its parts combined by `joined`; `first` in frame 0."""
    rows = np.full((1 + len(values), label_of.max()), first)
    for t, row in enumerate(values, 1):
        joined.at(rows[t], label_of[1:] - 1, row)
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
    group_labels: np.ndarray,
) -> list[Media]:
    """Write the plots.

    Args:
        folder: of the run.
        tracking, recording: what was tracked, with the truth.
        scores: those of views.
        motion: scores of objects, by label.
        names: names of objects, by label.
        group_labels: the label of each group, [K+1], which gives it its colour.
    """
    written = []

    def keep(name: str, figure: plots.Figure, caption: str) -> None:
        written.append(Media(plots.save(figure, folder.plot(name)), caption))

    labels, moved = {name: label for label, name in names.items()}, tracking.num_frames > 1
    frames = recording.tracked.frame_ids
    scored = {names[k]: s.centroid_errors_mm for k, s in motion.items() if k in names and s.num_scored}
    if moved and scored:
        figure = plots.error_over_frames(scored, labels, limit_mm=5.0, frames=frames)
        keep("centroid_error", figure, "Distance of each object's centroid from the truth")
    if moved:
        times = plots.update_time(np.array([np.nan, *tracking.update_s[1:]]), frames)
        keep("update_time", times, "Time of each update, without compiling")
    if scores.num_frames > 1:
        held_out, tracked = (
            {
                f"camera {camera}": np.asarray(found.values["psnr"])
                for camera, found in scores.cameras.items()
                if found.held_out == kind
            }
            for kind in (True, False)
        )
        keep("psnr", plots.psnr_over_frames(tracked, held_out, frames), "PSNR of rendered pictures")
    if moved:
        paths = _centroids(tracking, names, group_labels)
        both = paths, _true_paths(recording, tracking, paths, names)
        origin = recording.tracked.origin
        found, true = ({name: in_world(path, origin) for name, path in each.items()} for each in both)
        figure = plots.trajectories(found, labels, true)
        keep("paths", figure, "Centroids along x, y and z; ring: start, dot: end; thin lines: the truth")
    return written


def _centroids(tracking: Tracking, names: dict[int, str], group_labels: np.ndarray) -> dict[str, np.ndarray]:
    """The path of the centroid of each object's Gaussians, [T,3]."""
    labels, means = group_labels[np.asarray(tracking.scene.labels)], tracking.means()
    return {
        name: means[:, labels == label].mean(axis=1)
        for label, name in names.items()
        if (labels == label).any()
    }


def _true_paths(
    recording: Recording, tracking: Tracking, paths: dict[str, np.ndarray], names: dict[int, str]
) -> dict[str, np.ndarray]:
    """The paths that the same centroids have under the true motion."""
    truth, true = recording.tracked.truth, {}
    if truth is None:
        return true
    for i, label in enumerate(truth.label_ids):
        name = names.get(int(label))
        if name in paths:
            motion = relative_motion(truth.poses[: tracking.num_frames, i])
            true[name] = motion[:, :3, :3] @ paths[name][0] + motion[:, :3, 3]
    return true
