"""Saving and loading the state from which an unfinished run of `gsjax track` resumes."""

from pathlib import Path

import jax
import numpy as np

from gsjax.engine import saving
from gsjax.engine.drive import Tick
from gsjax.engine.files import read_arrays
from gsjax.engine.inputs import Inputs, expect_same
from gsjax.engine.track.loop import Tracking
from gsjax.io.atomic import write_npz
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, save_checkpoint
from gsjax.methods.track import Pose, Track, TrackConfig, first_pose

_PER_UPDATE = ("visible", "lost", "turn_known", "agrees")
_AGAIN = "start again with --overwrite in place of --resume"


class Saver:
    """Writes the state of a run into its folder `resume/`, and the poses that are new since the last save.

    Args:
        folder: RUN/resume.
        about: digests of the run's inputs, by their descriptions.
        saved: number of frames stored there already.
    """

    def __init__(self, folder: Path, about: Inputs, saved: int = 0):
        self._folder, self._about, self._saved = folder, about, saved
        self._save = saving.Saver("tracking")

    def __call__(self, tracking: Tracking, *, last: bool) -> None:
        """Save if the last save is long enough ago or this is the last one; warn if it cannot be written."""
        self._save(lambda: self._write(tracking), last=last)

    def _write(self, tracking: Tracking) -> None:
        assert tracking.tick is not None
        for path in _parts(self._folder):
            if _frames_of(path) > self._saved:  # left by a save that failed, or by an earlier run
                path.unlink()
        news = tracking.poses[max(self._saved, 1) :]  # the first one is the scene's own
        if news:
            poses = jax.tree.map(lambda *rows: np.stack(rows), *news)
            part = self._folder / f"poses_{tracking.num_frames:06d}.npz"  # up to this many frames
            write_npz(part, {"means": poses.means, "quats": poses.quats})
        metadata = {
            "about": dict(self._about),
            "frames": tracking.num_frames,
            "joined": tracking.joined,
            "update_s": tracking.update_s,
            "skipped": tracking.skipped,
            "everywhere": tracking.everywhere,
            **{name: [row.tolist() for row in getattr(tracking, name)] for name in _PER_UPDATE},
        }
        tree = {"scene": tracking.scene, "run": tracking.tick.run}
        save_checkpoint(self._folder / "state.npz", tree, metadata)
        self._saved = tracking.num_frames


def load(folder: Path, config: TrackConfig, about: Inputs) -> Tracking:
    """The tracking saved in a folder RUN/resume by a run with this config.

    Args:
        folder: RUN/resume.
        config: the settings of the tracker.
        about: digests of the inputs, by their descriptions.

    Raises:
        ValueError: nothing was saved there, or it is damaged, or of another version of gsjax; or the run was
            started with other inputs.
    """
    path = folder / "state.npz"
    if not path.is_file():
        raise ValueError(
            f"--resume: {folder.parent} was stopped before its first update, so nothing was saved; {_AGAIN}"
        )
    tree, found = load_checkpoint(path)
    if missing := [name for name in _PER_UPDATE if name not in found]:
        raise CheckpointError(
            f"{path}: expected {missing[0]} of each update, found a run of another version of gsjax; {_AGAIN}"
        )
    expect_same(found.pop("about", {}), about, folder.parent)
    scene, run = tree["scene"], tree["run"]
    chosen = run.kept.chosen
    start = jax.device_get(first_pose(scene))
    frames = found.pop("frames")
    poses = [start, *_saved_poses(folder, frames, start)]
    rows = {name: [np.asarray(row) for row in found.pop(name)] for name in _PER_UPDATE}
    tick = Tick(Track(config if chosen is None else chosen.config), None, run, {}, 0.0, 0.0)
    return Tracking(scene, poses, tick, resumed=frames, **found, **rows)


def _parts(folder: Path) -> list[Path]:
    """The files of poses, in order."""
    return sorted(folder.glob("poses_*.npz"))


def _frames_of(part: Path) -> int:
    return int(part.stem.removeprefix("poses_"))


def _saved_poses(folder: Path, frames: int, like: Pose) -> list[Pose]:
    """The poses after the first one. Files written after the state are from an earlier run."""
    poses = []
    for path in _parts(folder):
        if _frames_of(path) <= frames:
            part = read_arrays(path, ("means", "quats"), _AGAIN)
            rows = zip(part["means"], part["quats"], strict=True)  # on the host, as `follow` keeps them
            poses.extend(jax.tree.unflatten(jax.tree.structure(like), row) for row in rows)
    if len(poses) != frames - 1:
        raise CheckpointError(
            f"{folder}: expected the poses of {frames - 1} updates, found {len(poses)}; parts are missing; "
            f"{_AGAIN}"
        )
    return poses
