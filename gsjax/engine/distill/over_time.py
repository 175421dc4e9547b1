"""The result of a query of a field, followed over the frames of the tracked run that its scene is from: the
Gaussians carry the field along, so no encoder runs again."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool
from rich.console import Console
from rich.progress import track

from gsjax.data.photographs import photographs_of
from gsjax.engine.distill.saved import FieldRun
from gsjax.engine.messages import Notes, describe
from gsjax.engine.pictures import MARK, MIN_SHARE, frame_rate, spotlight
from gsjax.engine.track.loop import Tracking
from gsjax.engine.track.saved import SavedRun, open_run, read_tracking
from gsjax.io.atomic import write_npz
from gsjax.io.video import VideoWriter
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import in_world
from gsjax.viz.viewer import Motion, moved
from gsjax.viz.viewer.drawing import Drawer


@dataclass(frozen=True, eq=False)
class OverTime:
    """A tracked run whose first frame is the scene of a field.

    Attributes:
        tracking: the scene over time.
        origin: what its positions are relative to, if they lie far from 0.
        saved: the run with its recording; None if the recording is gone.
    """

    tracking: Tracking
    origin: Any
    saved: SavedRun | None

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """Numbers of the frames in the recording; 0, 1, ... without it."""
        count = self.tracking.num_frames
        return tuple(range(count) if self.saved is None else self.saved.recording.tracked.frame_ids[:count])

    def motion(self, gaussians: Gaussians) -> Motion:
        """The motion of the scene.

        Args:
            gaussians: in the first frame, in any colours.
        """
        moving = self.tracking.scene.num_moving
        return moved(gaussians, self.tracking.means()[:, :moving], self.tracking.quats())

    def write(
        self,
        folder: Path,
        selected: Bool[np.ndarray, "n"],
        film: Callable[[np.ndarray], dict[str, np.ndarray]] | None = None,
    ) -> None:
        """Write over_time.npz: the number of each frame (`frames`), the means of what was found [T,n,3], and
        what `film` returns. If most of the Gaussians found belong to objects, the others are left out, as
        they would stay behind when the objects move.

        Args:
            folder: for the file.
            selected: what was found.
            film: films it (see `film`); None for no film.
        """
        carried = selected & (np.asarray(self.tracking.scene.labels) != 0)
        selected = carried if 2 * carried.sum() > selected.sum() else selected
        means = in_world(self.tracking.means()[:, selected], self.origin)
        filmed = {} if film is None else film(selected)
        write_npz(folder / "over_time.npz", {"frames": np.array(self.frame_ids), "means": means, **filmed})

    def film(
        self,
        path: Path,
        paint: Callable[[np.ndarray], Gaussians],
        camera: str | None,
        drawer: Drawer,
        notes: Notes,
        console: Console,
        selected: Bool[np.ndarray, "n"],
    ) -> dict[str, np.ndarray]:
        """Write a video of a camera's frames in which what was found keeps its colours and the rest is
        dimmed. Returns the time of each frame (`times`) and the number of pixels that show what was found
        (`pixels`); nothing without the recording.

        Args:
            path: the video.
            paint: colours the scene: red is 1 for the Gaussians given, else 0.
            camera: its name (default, and if no camera has that name: the first held-out one, else the first
                tracked).
            drawer: renders the scene.
            notes: receives a warning if nothing can be filmed.
            console: shows the progress.
            selected: what was found.
        """
        if self.saved is None:
            return {}
        try:
            return self._film(self.saved, path, paint(selected), camera, drawer, console)
        except (ValueError, OSError) as error:
            notes.warn(f"the selection is not filmed: {describe(error)}")
            return {}

    def _film(
        self,
        saved: SavedRun,
        path: Path,
        painted: Gaussians,
        camera: str | None,
        drawer: Drawer,
        console: Console,
    ) -> dict[str, np.ndarray]:
        ids = {str(one): one for one in saved.recording.judged.camera_ids}
        motion, pixels = self.motion(painted), []
        sequence = saved.seen_by(ids.get(camera or "")).tracked.select(frames=slice(0, motion.num_frames))
        photographs = photographs_of(sequence)
        with VideoWriter(path, frame_rate(sequence.times)) as video:
            for t in track(range(motion.num_frames), "filming", console=console, transient=True):
                there = jax.tree.map(lambda a: a[None], photographs.camera(t))
                mask = drawer(motion.at(t), there).colors[..., 0] > MIN_SHARE
                pixels.append(int(mask.sum()))
                video.write(spotlight(photographs.image(t), mask, MARK))
        return {"times": np.asarray(sequence.times), "pixels": np.array(pixels)}


def over_time_of(run: FieldRun, notes: Notes) -> OverTime | None:
    """The tracked run of a field's scene; None if the scene is not from a tracked run.

    Args:
        run: the field and its scene.
        notes: receives warnings.
    """
    folder = run.file.absolute().parent
    if run.file.name != "scene.ply" or not (folder / "trajectory.npz").is_file():
        return None
    try:
        saved: SavedRun | None = open_run(folder)
    except (ValueError, OSError) as error:
        notes.warn(f"the selection is not filmed: {describe(error)}")
        saved = None
    try:
        tracking, origin = read_tracking(folder) if saved is None else (saved.tracking, run.origin)
    except (ValueError, OSError) as error:
        notes.warn(f"the selection is not followed over time: {describe(error)}")
        return None
    return if_same_size(run, OverTime(tracking, origin, saved), notes)


def if_same_size(run: FieldRun, over_time: OverTime, notes: Notes) -> OverTime | None:
    """The tracked run if it has as many Gaussians as the field's scene; else None, with a warning.

    Args:
        run: the field and its scene.
        over_time: the tracked run.
        notes: receives the warning.
    """
    if over_time.tracking.scene.gaussians.num == run.gaussians.num:
        return over_time
    notes.warn("the selection is not followed over time: some Gaussians of the run cannot be drawn")
    return None
