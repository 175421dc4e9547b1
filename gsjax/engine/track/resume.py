"""What an unfinished run leaves behind from time to time, so that another can go on from it."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gsjax.engine import saving
from gsjax.engine.track.loop import Tracking
from gsjax.io.atomic import write_npz
from gsjax.io.checkpoints import CheckpointError, load_checkpoint, load_metadata, save_checkpoint
from gsjax.methods.track import (
    Pose,
    TrackConfig,
    Tracked,
    TrackedScene,
    first_pose,
    first_state,
)
from gsjax.methods.track.budget import Chosen, Costs, ladder
from gsjax.scene.frame import Frame
from gsjax.scene.gaussians import Gaussians


class Saver:
    """Writes the state of a run into its folder `resume/`, and what poses have come since the last time.

    Args:
        folder: RUN/resume.
        saved: how many frames stand there already.
    """

    def __init__(self, folder: Path, saved: int = 0):
        self._folder, self._saved, self._save = folder, saved, saving.Saver("tracking")

    def __call__(self, tracking: Tracking, update: Tracked, *, last: bool) -> None:
        """Save if the last time is long enough ago, or this is the last; where the disk is full, say so."""
        self._save(lambda: self._write(tracking, update), last=last)

    def _write(self, tracking: Tracking, update: Tracked) -> None:
        for path in _parts(self._folder):
            if _frames_of(path) > self._saved:  # a state that failed to follow, or one of another life
                path.unlink()
        news = tracking.poses[max(self._saved, 1) :]  # the first one is the scene's own
        if news:
            poses = jax.tree.map(lambda *rows: np.stack(rows), *news)
            write_npz(_part(self._folder, tracking.num_frames), {"means": poses.means, "quats": poses.quats})
        metadata = {
            "frames": tracking.num_frames,
            "first": _shapes(tracking.scene),
            "final": _shapes(update.scene),
            "joined": tracking.joined,
            "update_s": tracking.update_s,
            "skipped": tracking.skipped,
            "visible": [seen.tolist() for seen in tracking.visible],
            "lost": [lost.tolist() for lost in tracking.lost],
            "turn_known": [known.tolist() for known in tracking.turn_known],
            "everywhere": tracking.everywhere,
            "chosen": _chosen_metadata(update.chosen),
        }
        tree = (tracking.scene, update.scene, update.pose, update.state)
        save_checkpoint(self._folder / "state.npz", tree, metadata)
        self._saved = tracking.num_frames


def load(folder: Path, first: Frame, config: TrackConfig) -> tuple[Tracking, Tracked]:
    """What a run had come to, and its last update, to go on from.

    Args:
        folder: RUN/resume.
        first: what the tracked cameras saw at first.
        config: the tracker's.

    Raises:
        ValueError: nothing was saved there, or it is damaged.
    """
    path = folder / "state.npz"
    if not path.is_file():
        raise ValueError(f"--resume: {folder.parent} was stopped before its state was saved; leave it out")
    found = load_metadata(path)
    chosen = _chosen(found["chosen"], config, len(first.images))
    scene, final = _blank_scene(**found["first"]), _blank_scene(**found["final"])
    pose = first_pose(final)
    state = first_state(final, pose, first, config if chosen is None else chosen.config)
    (scene, final, pose, state), _ = load_checkpoint(path, (scene, final, pose, state))
    start = jax.device_get(first_pose(scene))
    poses = [start, *_saved_poses(folder, found["frames"], jax.tree.structure(start))]
    tracking = Tracking(
        scene,
        poses,
        final=final,
        joined=found["joined"],
        update_s=found["update_s"],
        skipped=found["skipped"],
        visible=[np.asarray(seen) for seen in found["visible"]],
        lost=[np.asarray(lost) for lost in found["lost"]],
        turn_known=[np.asarray(known) for known in found["turn_known"]],
        everywhere=found["everywhere"],
        chosen=chosen,
        resumed=found["frames"],
    )
    return tracking, Tracked(final, pose, state, {}, 0.0, 0.0, None, 0, chosen)


def _part(folder: Path, frames: int) -> Path:
    """The poses up to so many frames, since the part before."""
    return folder / f"poses_{frames:06d}.npz"


def _parts(folder: Path) -> list[Path]:
    """All of them, in order."""
    return sorted(folder.glob("poses_*.npz"))


def _frames_of(part: Path) -> int:
    return int(part.stem.removeprefix("poses_"))


def _saved_poses(folder: Path, frames: int, structure: Any) -> list[Pose]:
    """The poses after the first one. Parts that were written after the state are of another life."""
    poses = []
    for path in _parts(folder):
        if _frames_of(path) <= frames:
            with np.load(path, allow_pickle=False) as part:
                rows = zip(part["means"], part["quats"], strict=True)  # on the host, as `follow` keeps them
                poses.extend(jax.tree.unflatten(structure, row) for row in rows)
    if len(poses) != frames - 1:
        raise CheckpointError(
            f"{folder}: expected the poses of {frames - 1} updates, found {len(poses)}; parts are missing. "
            "Begin anew without --resume"
        )
    return poses


def _shapes(scene: TrackedScene) -> dict[str, Any]:
    shN = scene.gaussians.shN
    return {
        "count": scene.gaussians.num,
        "moving": scene.num_moving,
        "label_ids": list(scene.label_ids),
        "bands": None if shN is None else shN.shape[1],
    }


def _blank_scene(count: int, moving: int, label_ids: list[int], bands: int | None) -> TrackedScene:
    """A scene of these shapes."""
    gaussians = Gaussians(
        means=jnp.zeros((count, 3)),
        quats=jnp.zeros((count, 4)),
        log_scales=jnp.zeros((count, 3)),
        logit_opacities=jnp.zeros(count),
        sh0=jnp.zeros((count, 1, 3)),
        shN=None if bands is None else jnp.zeros((count, bands, 3)),
    )
    labels = jnp.zeros(count, jnp.int32)
    return TrackedScene(gaussians, jnp.zeros((moving, 3)), labels, tuple(label_ids), moving)


def _chosen_metadata(chosen: Chosen | None) -> dict[str, Any] | None:
    if chosen is None:
        return None
    return {
        "name": chosen.name,
        "fits": chosen.fits,
        "tried": {name: list(costs) for name, costs in chosen.tried.items()},
    }


def _chosen(found: dict[str, Any] | None, config: TrackConfig, num_cameras: int) -> Chosen | None:
    if found is None:
        return None
    tried = {name: Costs(*costs) for name, costs in found["tried"].items()}
    rung = ladder(config, num_cameras)[found["name"]]
    return Chosen(found["name"], rung, tried[found["name"]], tried, found["fits"])
