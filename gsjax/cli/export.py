"""`gsjax export`: the Gaussians of a run or a file in another format, or as a page that shows them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import Common
from gsjax.engine.viewables import UP, Up, open_viewable
from gsjax.io.page import Film
from gsjax.io.scenes import FORMATS, format_of, write_gaussians
from gsjax.viz.viewer import Viewable
from gsjax.viz.viewer.cameras import scene_up
from gsjax.viz.viewer.player import frame_pause

HELP = (
    " The ending of OUT names the format: .ply (3DGS), .compressed.ply (PlayCanvas), .splat, .spz (Niantic), "
    ".sog (PlayCanvas), .glb (glTF with KHR_gaussian_splatting), or .html, a page that opens from disk."
)


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax export`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE")]
    """Folder of a run of `gsjax fit`, `track`, `parts` or `deform` (its first frame), or a file of Gaussians:
    .ply, .compressed.ply, .splat, .spz, .sog or .ksplat."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write."""
    up: Up = "auto"
    """The up direction of a page; auto: that of a run's photographs, else -y, as in most files."""
    overwrite: bool = False
    """Replace OUT if it is there."""


def run(options: Options) -> int:
    """Write the file; returns the exit code.

    Raises:
        ValueError, OSError: there is no such scene, no format of that ending, or OUT is there already.
    """
    written = format_of(options.out)
    _check(options)
    if options.up != "auto" and "up" not in written.options:
        raise ValueError(f"--up: expected OUT to be a page (.html), found {options.out}; leave it out")
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            scene, _ = open_viewable(options.path, notes)
        if scene.num_frames > 1 and "film" not in written.options:
            notes.warn(f"{options.path} moves; only its first of {scene.num_frames} frames is written")
        look: dict[str, Any] = {}
        if "up" in written.options:
            known = scene_up(scene) if options.path.is_dir() else UP["-y"]
            look["up"] = (known if options.up == "auto" else UP[options.up]).tolist()
            look["background"] = scene.background
            look["film"] = _film_of(scene)
        with stage(console, f"writing {options.out}"):
            left_out = write_gaussians(
                options.out, scene.gaussians, antialiased=scene.antialiased, origin=scene.origin, **look
            )
        for what in left_out:
            notes.warn(f"{options.out}: {written.name} leaves out {what}")
    size = options.out.stat().st_size
    text = f"{scene.gaussians.num:,} Gaussians, {written.name}, {_megabytes(size)}"
    Console(highlight=False).print(f"[bold]scene[/]  {options.out}: {text}", soft_wrap=True)
    return 0


def _film_of(scene: Viewable) -> Film | None:
    """A scene over time, at the rate of its recording; None if it stands still."""
    if scene.num_frames == 1:
        return None
    times = scene.times
    if times is None:
        times = np.arange(scene.num_frames) * frame_pause(None)
    return Film(scene.at, times, scene.num_moving)


def _check(options: Options) -> None:
    """Raises an OSError where OUT must not be written."""
    out = options.out
    if out.is_dir():
        raise IsADirectoryError(
            f"{out}: expected a file, found a folder; name one in it that ends in {', '.join(FORMATS)}"
        )
    if out.exists() and options.path.exists() and out.samefile(options.path):
        raise FileExistsError(f"{out}: expected another file than the one that is read; name another OUT")
    if out.exists() and not options.overwrite:
        raise FileExistsError(f"{out}: is there already; name another OUT, or replace it with --overwrite")


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
