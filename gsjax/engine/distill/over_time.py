"""What a query of a field finds, over the frames of the tracked run whose Gaussians carry the field along: no
encoder runs again."""

from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Bool
from rich.console import Console
from rich.progress import track

from gsjax.data.photographs import photographs_of
from gsjax.engine.distill.query import MARK, MOST
from gsjax.engine.distill.saved import FieldRun
from gsjax.engine.messages import Notes, describe
from gsjax.engine.pictures import frame_rate, lit
from gsjax.engine.track.saved import SavedRun, open_run
from gsjax.io.atomic import write_npz
from gsjax.io.video import VideoWriter
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.origin import in_world
from gsjax.viz.viewer import Motion, moved
from gsjax.viz.viewer.drawing import Drawer


@dataclass(frozen=True, eq=False)
class OverTime:
    """The tracked run whose first frame the scene of a field is.

    Attributes:
        saved: the run.
    """

    saved: SavedRun

    @property
    def frame_ids(self) -> tuple[int, ...]:
        """Numbers of the frames."""
        return tuple(self.saved.recording.tracked.frame_ids[: self.saved.tracking.num_frames])

    def motion(self, gaussians: Gaussians) -> Motion:
        """The motion of the scene.

        Args:
            gaussians: in the first frame, in any colours.
        """
        tracking = self.saved.tracking
        return moved(gaussians, tracking.means()[:, : tracking.scene.num_moving], tracking.quats())

    def write(
        self,
        folder: Path,
        shares: Gaussians,
        selected: Bool[np.ndarray, "n"],
        camera: int | None,
        drawer: Drawer,
        console: Console,
    ) -> None:
        """Write video.mp4, the frames of a camera with what was found in its colours and the rest dimmed; and
        over_time.npz: the number of each frame (`frames`), its time (`times`), the means of what was found
        [T,n,3], and the number of pixels that show it (`pixels`).

        Args:
            folder: for the files.
            shares: the scene; red is 1 in what was found, else 0.
            selected: what was found.
            camera: its id (default: the first held-out one, else the first tracked).
            drawer: draws the scene.
            console: shows the progress.
        """
        saved, motion, pixels = self.saved, self.motion(shares), []
        sequence = saved.seen_by(camera).tracked.select(frames=slice(0, motion.num_frames))
        photographs = photographs_of(sequence)
        with VideoWriter(folder / "video.mp4", frame_rate(sequence.times)) as video:
            for t in track(range(motion.num_frames), "filming", console=console, transient=True):
                there = jax.tree.map(lambda a: a[None], photographs.camera(t))
                mask = drawer(motion.at(t), there).colors[..., 0] > MOST
                pixels.append(int(mask.sum()))
                video.write(lit(photographs.image(t), mask, MARK))
        means = in_world(saved.tracking.means()[:, selected], saved.recording.tracked.origin)
        arrays = {"frames": np.asarray(sequence.frame_ids), "times": sequence.times, "means": means}
        write_npz(folder / "over_time.npz", arrays | {"pixels": np.array(pixels)})


def over_time_of(run: FieldRun, notes: Notes) -> OverTime | None:
    """The tracked run of a field's scene; None where there is none, or it cannot be read.

    Args:
        run: the field and its scene.
        notes: receives a warning where it cannot be read.
    """
    folder = run.file.absolute().parent
    if run.file.name != "scene.ply" or not (folder / "trajectory.npz").is_file():
        return None
    try:
        saved = open_run(folder)
    except (ValueError, OSError) as error:
        notes.warn(f"what is found is not followed over time: {describe(error)}")
        return None
    if saved.tracking.scene.gaussians.num != run.gaussians.num:
        notes.warn("what is found is not followed over time: some Gaussians of the run cannot be drawn")
        return None
    return OverTime(saved)
