"""`gsjax view`: a run or a PLY file in a web browser."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from rich.console import Console

from gsjax.engine.distill.saved import Whereabouts
from gsjax.engine.messages import Notes, say_error, stage
from gsjax.engine.options import Common
from gsjax.engine.viewables import open_viewable
from gsjax.io.atomic import write_new
from gsjax.io.pictures import write_png
from gsjax.optim.compiler import host_options
from gsjax.viz.viewer import Viewable, Viewer, open_viewer
from gsjax.viz.viewer.server import PORT, is_loopback, load_viser

_UP = {sign + axis: s * np.eye(3)[i] for sign, s in (("", 1), ("-", -1)) for i, axis in enumerate("xyz")}
_NUMBERED = re.compile(r"(\d+)_")


@dataclass(frozen=True)
class Options(Common):
    """What `gsjax view` is told."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FIELD|FILE.ply")]
    """Folder of a run of `gsjax fit`, `gsjax track`, `gsjax parts` or `gsjax deform`; of a field (`gsjax
    distill`); or a PLY file of Gaussians. A field, a fit with one and a deforming scene with names can be
    asked."""
    host: str = "127.0.0.1"
    """Address to listen on. Only this machine can look unless it is another than the default."""
    port: int | None = None
    """Port to listen on. 8080, or the next one that is free, unless given."""
    max_gaussians: int = 500_000
    """The browser gets so many Gaussians at most, the most opaque ones; our render has all."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Which way is up; as photographs were held, else z, unless given."""
    scene: Path | None = None
    """Of a field: the PLY file of its scene, where it is now."""
    images: str | None = None
    """Of a field or a fit: where the photographs are now."""
    weights: Path | None = None
    """Of what CLIP taught: the folder of its weights, where it is now."""


def run(options: Options) -> int:
    """Show it until Ctrl-C, whose exit code it returns.

    Raises:
        MissingExtra: viser is not installed.
        ValueError, OSError: there is nothing to look at, or nothing can listen at that address.
    """
    load_viser()  # before anything is read
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            now = Whereabouts(options.scene, options.images, options.weights)
            scene, folder = open_viewable(options.path, notes, now)
        if options.up != "auto":
            scene = replace(scene, up=_UP[options.up])
        with open_viewer(
            scene,
            host=options.host,
            port=options.port,
            max_gaussians=options.max_gaussians,
            save=screenshots(folder / "screenshots"),
            compiler_options=host_options(),
        ) as viewer:
            _say(options, scene, viewer, notes)
            try:
                viewer.wait()
            except KeyboardInterrupt:
                say_error("nobody can look any more", word="stopped")
    return 130


def _say(options: Options, scene: Viewable, viewer: Viewer, notes: Notes) -> None:
    """Where it can be looked at, and by whom."""
    num = scene.gaussians.num
    if num > options.max_gaussians:
        notes.warn(
            f"the browser gets the {options.max_gaussians} most opaque of {num} Gaussians "
            "(--max-gaussians); our render has all"
        )
    if options.port is None and viewer.port != PORT:
        notes.warn(f"port {PORT} is in use; this is {viewer.port} (--port names one)")
    if not is_loopback(options.host):
        notes.warn(
            f"--host {options.host}: everyone who reaches this machine over the network can look, and save "
            "screenshots and films here; there is no password"
        )
    console = Console(highlight=False)
    console.print(f"[bold]scene[/]   {in_words(scene)}", soft_wrap=True)
    console.print(f"[bold]view[/]    {viewer.url}   (Ctrl-C ends it)", soft_wrap=True)


def in_words(scene: Viewable) -> str:
    """How much there is to see."""
    told = [f"{scene.gaussians.num:,} Gaussians", f"SH degree {scene.gaussians.sh_degree}"]
    if scene.num_frames > 1:
        told.append(f"{scene.num_frames} frames")
    if scene.shots is not None:
        told.append(f"{len(scene.shots.names)} {'cameras' if scene.num_frames > 1 else 'photographs'}")
    if scene.asking is not None:
        told.append("can be asked")
    return ", ".join(told)


def screenshots(folder: Path) -> Callable[[str, np.ndarray], Path]:
    """Keeps pictures in a folder as NUMBER_KIND.png, numbered on; none is written over."""

    def save(kind: str, picture: np.ndarray) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(found[1]) for file in folder.iterdir() if (found := _NUMBERED.match(file.name))]
        names = (folder / f"{number:04d}_{kind}.png" for number in count(max(numbers, default=0) + 1))
        return write_new(names, lambda path: write_png(path, picture))

    return save
