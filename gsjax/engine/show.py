"""Showing a scene in a notebook cell: `gsjax.show`."""

import html
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from gsjax.io.scenes import is_scene, write_gaussians
from gsjax.io.sequences import frame_files
from gsjax.scene.gaussians import Gaussians

if TYPE_CHECKING:
    from gsjax.viz.viewer import Viewable
else:
    Viewable = Any  # slow to import, like everything that shows a scene

_STEP = 1 / 15  # seconds per frame


@dataclass(frozen=True)
class Shown:
    """A page that shows or plays a scene. A notebook displays it as the last value of a cell.

    Attributes:
        page: the HTML text, which needs neither a network nor a server.
        height: height of the page in the cell, pixels.
    """

    page: str = field(repr=False)
    height: int

    def _repr_html_(self) -> str:
        page = html.escape(self.page)
        return f'<iframe srcdoc="{page}" style="width: 100%; height: {self.height}px; border: 0"></iframe>'


def show(scene: Any, *, up: str | Sequence[float] | None = None, height: int = 480) -> Shown:
    """Show a scene in a notebook cell: drag to rotate, scroll to zoom, play if it moves.

    The page contains the scene, without view-dependent colour, in the colours of its first moment: 43 bytes
    per Gaussian, and 21 to 32 more per moment for each that moves, before compression. A saved notebook keeps
    the page: for millions of Gaussians, write one with `gsjax.write_gaussians` instead.

    Args:
        scene: Gaussians, or a list of them, one for each moment, with the same Gaussian in the same row; the
            result of `gsjax.track`, `parts` or `deform`; a film of edited parts, layers in a tuple; what
            `gsjax.open_scene` opened, or a path as for it.
        up: the up direction, [3], or by its name: "z", "-y" (default: that of a run's photographs; for a path
            without any -y, as in most files; else +z).
        height: height of the page in the cell, pixels.

    Raises:
        FileNotFoundError: there is no scene at the path.
        TypeError: it is none of these.
        ValueError: there are no Gaussians, one has a number that is not finite, moments differ in their
            number of Gaussians, or `up` is not a direction.
    """
    opened, path = _opened(scene)
    options = page_options(opened, range(opened.num_frames), path)
    if up is not None:
        options["up"] = _direction(up)
    with TemporaryDirectory() as folder:
        page = Path(folder) / "scene.html"
        write_gaussians(page, opened.at(0), **options)
        return Shown(page.read_text(encoding="utf-8"), int(height))


def page_options(scene: Viewable, frames: range, path: Path | None) -> dict[str, Any]:
    """How a page shows a scene: the arguments of `gsjax.io.page.write_page` besides the Gaussians.

    Args:
        scene: the scene.
        frames: the frames to play, if the scene moves in them.
        path: where the scene was read from; None if it was not.
    """
    from gsjax.io.page import Film
    from gsjax.viz.viewer.cameras import first_pose, scene_up
    from gsjax.viz.viewer.player import frame_pause

    unknown = path is not None and scene.up is None and scene.shots is None  # then -y, as in most files
    options: dict[str, Any] = {
        "antialiased": scene.antialiased,
        "up": [0.0, -1.0, 0.0] if unknown else scene_up(scene).tolist(),
        "background": scene.background,
    }
    if scene.shots is not None:  # outdoor fits have Gaussians far beyond what was photographed
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
    if is_scene(path / "meta.json"):  # an unpacked SOG
        path = path / "meta.json"
    return {file.resolve() for file in frame_files(path) or [path] if file.is_file()}


def _opened(scene: Any) -> tuple[Viewable, Path | None]:
    """The scene to show, and the path it was read from, if any."""
    from gsjax.engine.checkpoint import open_scene
    from gsjax.viz.viewer import Viewable as Scene

    if isinstance(scene, str | os.PathLike):
        return open_scene(scene), Path(scene)
    if isinstance(scene, Scene):
        return scene, None
    moments = _moments(scene)
    if len(moments) == 1:
        return Scene("scene", moments[0]), None
    return _playing(moments), None


def _moments(scene: Any) -> list[Gaussians]:
    """The Gaussians at each moment.

    Raises:
        TypeError: the scene has none.
    """
    from gsjax.methods.deform import DeformResult
    from gsjax.methods.parts import PartsResult
    from gsjax.methods.parts.film import Layer, film_gaussians
    from gsjax.methods.track import Tracked

    if isinstance(scene, Gaussians):
        return [scene]
    if isinstance(scene, Tracked):
        return [scene.gaussians()]
    if isinstance(scene, PartsResult):
        return [scene.at(int(t)) for t in np.flatnonzero(scene.done)]
    if isinstance(scene, DeformResult):
        return [scene.at(time) for time in scene.timeline.times.tolist()]
    if isinstance(scene, tuple) and scene and isinstance(scene[0], Layer):
        return [film_gaussians(scene, t) for t in range(len(scene[0].trajectory.times))]
    moments = list(scene) if isinstance(scene, Iterable) else [scene]
    others = [type(one).__name__ for one in moments if not isinstance(one, Gaussians)]
    if others:
        raise TypeError(
            "scene: expected Gaussians, a list of them, the result of gsjax.track, parts or deform, a film "
            f"of edited parts, what gsjax.open_scene opened, or a path; found {type(scene).__name__}"
            + (f" with {others[0]}" if others[0] != type(scene).__name__ else "")
        )
    return moments


def _playing(moments: list[Gaussians]) -> Viewable:
    """The scene of several moments."""
    from gsjax.viz.viewer import Motion
    from gsjax.viz.viewer import Viewable as Scene

    counts = sorted({moment.num for moment in moments})
    if len(counts) != 1:
        found = f"{counts[0]} to {counts[-1]}" if counts else "no moment"
        raise ValueError(f"scene: expected moments of the same number of Gaussians, found {found}")
    motion = Motion(len(moments), counts[0], moments.__getitem__)
    return Scene("scene", moments[0], motion=motion, times=_STEP * np.arange(len(moments)))


def _direction(up: str | Sequence[float]) -> list[float]:
    """The up direction as a unit vector."""
    from gsjax.engine.viewables import UP

    if isinstance(up, str) and up not in UP:
        raise ValueError(f"up: expected three numbers or one of {', '.join(UP)}, found {up!r}")
    found = np.asarray(UP[up] if isinstance(up, str) else up, float)
    length = np.linalg.norm(found)
    if found.shape != (3,) or not 0 < length < np.inf:
        raise ValueError(f"up: expected three finite numbers that are not all 0, found {up}")
    return (found / length).tolist()
