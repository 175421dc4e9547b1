"""A scene in the cell of a notebook: `gsjax.show`."""

import html
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from gsjax.io.sequences import frame_files
from gsjax.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsjax.viz.viewer import Viewable
else:
    Viewable = Any  # slow to import, as all that shows a scene is

_STEP = 1 / 15  # seconds that a frame is shown


@dataclass(frozen=True)
class Shown:
    """A page that shows or plays a scene. As the last value of a notebook's cell, it is shown there.

    Attributes:
        page: the HTML text, which needs neither a network nor a program beside it.
        height: of the cell's frame, pixels.
    """

    page: str = field(repr=False)
    height: int

    def _repr_html_(self) -> str:
        page = html.escape(self.page)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: {self.height}px; border: 0"></iframe>'


def show(
    scene: Gaussians | Sequence[Gaussians] | Viewable | str | os.PathLike,
    *,
    up: Sequence[float] | None = None,
    height: int = 480,
) -> Shown:
    """A scene to look at in a notebook's cell: drag to turn, scroll to come closer, play if it moves.

    The page holds the scene: 43 bytes for each Gaussian, and 21 more for each in each frame in which it
    moves.

    Args:
        scene: Gaussians, or a list of them, one for each moment, with the same Gaussian in the same row; what
            `gsjax.open_scene` opened, or the path that it takes.
        up: the up direction, [3] (default: that of a run's photographs; of files -y, as in most; else +z).
        height: of the cell's frame, pixels.

    Raises:
        FileNotFoundError: there is no scene at the path.
        ValueError: there is no Gaussian, one holds a number that is not finite, or moments differ in their
            number.
    """
    from gsjax.io.scenes import write_gaussians

    opened, path = _opened(scene)
    options = page_options(opened, range(opened.num_frames), path)
    if up is not None:
        options["up"] = np.asarray(up, float).tolist()
    with TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        write_gaussians(page, opened.at(0), **options)
        return Shown(page.read_text(encoding="utf-8"), height)


def page_options(scene: Viewable, frames: range, path: Path | None) -> dict[str, Any]:
    """How a page shows a scene: what `gsjax.io.page.write_page` takes beside the Gaussians.

    Args:
        scene: the scene.
        frames: those that it plays, if it moves in them.
        path: where it was read; None if it was not.
    """
    from gsjax.io.page import Film
    from gsjax.viz.viewer.cameras import first_pose, scene_up
    from gsjax.viz.viewer.player import frame_pause

    of_files = path is not None and bool(files_of(path))
    options: dict[str, Any] = {
        "antialiased": scene.antialiased,
        "up": [0.0, -1.0, 0.0] if of_files else scene_up(scene).tolist(),
        "background": scene.background,
    }
    if scene.shots is not None:  # a fit in the open has Gaussians far beyond what was photographed
        options["view"] = tuple(place.tolist() for place in first_pose(scene)[:2])
        options["near"] = scene.shots.near
    if len(frames) > 1 and scene.num_moving > 0:
        times = scene.times
        if times is None:
            times = np.arange(scene.num_frames) * frame_pause(None)
        shown = np.asarray(times)[frames]
        options["film"] = Film(lambda frame: scene.at(frames[frame]), shown, scene.num_moving)
    return options


def files_of(path: Path) -> set[Path]:
    """The files of Gaussians at a path; none if it is a run.

    Args:
        path: a file, a folder of numbered ones, or a run.
    """
    return {file.resolve() for file in frame_files(path) or [path] if file.is_file()}


def _opened(scene: Any) -> tuple[Viewable, Path | None]:
    """The scene to look at, and where it was read."""
    from gsjax.engine.checkpoint import open_scene
    from gsjax.viz.viewer import Motion
    from gsjax.viz.viewer import Viewable as Scene

    if isinstance(scene, str | os.PathLike):
        return open_scene(scene), Path(scene)
    if isinstance(scene, Scene):
        return scene, None
    if isinstance(scene, Gaussians):
        return Scene("scene", scene), None
    moments = list(scene)
    counts = sorted({moment.num for moment in moments})
    if len(counts) != 1:
        found = f"{counts[0]} to {counts[-1]}" if counts else "no moment"
        raise ValueError(f"scene: expected moments of the same number of Gaussians, found {found}")
    motion = Motion(len(moments), counts[0], moments.__getitem__)
    return Scene("scene", moments[0], motion=motion, times=_STEP * np.arange(len(moments))), None
