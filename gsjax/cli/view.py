"""`gsjax view`: a run or a file of Gaussians in a web browser."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.text import Text

from gsjax.engine.distill.saved import Locations
from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import Common
from gsjax.engine.streams import say_error
from gsjax.engine.viewables import UP, Up, open_viewable
from gsjax.io.atomic import write_new
from gsjax.io.pictures import write_png
from gsjax.optim.compiler import host_options
from gsjax.viz.viewer import Viewable, Viewer, open_viewer
from gsjax.viz.viewer.markup import contents
from gsjax.viz.viewer.server import PORT, is_loopback, load_viser

_NUMBERED = re.compile(r"(\d+)_")


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax view`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FIELD|FILE")]
    """Folder of a run of `gsjax fit`, `gsjax track`, `gsjax parts` or `gsjax deform`; of a field (`gsjax
    distill`); of a film (`gsjax edit`); a file of Gaussians: .ply, .compressed.ply, .splat, .spz, .sog or
    .ksplat; or a folder of numbered ones, the frames of a scene. A field, a fit with one and a deforming
    scene with names can be queried."""
    host: str = "127.0.0.1"
    """Address to listen on. With the default, only this machine can connect."""
    port: int | None = None
    """Port to listen on; default: 8080, or the next free one."""
    max_gaussians: int = 500_000
    """Largest number of Gaussians that the browser receives (the most opaque); gsjax's own render has all."""
    up: Up = "auto"
    """The up direction; auto: that of the photographs, else z."""
    scene: Path | None = None
    """Current path of the file of a field's scene."""
    images: str | None = None
    """Current path of the photographs of a field or a fit."""
    weights: Path | None = None
    """Current folder of CLIP's weights, for features of CLIP."""


def run(options: Options) -> int:
    """Show the scene until Ctrl-C; returns its exit code.

    Raises:
        MissingExtra: viser is not installed.
        ValueError, OSError: there is no such scene, or nothing can listen at that address.
    """
    load_viser()  # before anything is read
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            now = Locations(options.scene, options.images, options.weights)
            scene, folder = open_viewable(options.path, notes, now)
        if options.up != "auto":
            scene = replace(scene, up=UP[options.up])
        with open_viewer(
            scene,
            host=options.host,
            port=options.port,
            max_gaussians=options.max_gaussians,
            save=screenshots(folder / "screenshots"),
            compiler_options=host_options(),
        ) as viewer:
            _announce(options, scene, viewer, notes)
            try:
                viewer.wait()
            except KeyboardInterrupt:
                say_error("the page is no longer served", word="stopped")
    return 130


def _announce(options: Options, scene: Viewable, viewer: Viewer, notes: Notes) -> None:
    """Print the address, and who can connect."""
    num = scene.gaussians.num
    if num > options.max_gaussians:
        notes.warn(
            f"the browser gets the {options.max_gaussians} most opaque of {num} Gaussians "
            "(--max-gaussians); gsjax's own render has all"
        )
    if options.port is None and viewer.port != PORT:
        notes.warn(f"port {PORT} is in use; this is {viewer.port} (--port names one)")
    if not is_loopback(options.host):
        notes.warn(
            f"--host {options.host}: everyone who reaches this machine over the network can view the scene, "
            "and save screenshots and films here; there is no password"
        )
    console = Console(highlight=False)
    console.print(f"[bold]scene[/]   {', '.join(_facts(scene))}", soft_wrap=True)
    address = Text.assemble(("view", "bold"), f"    {viewer.url}   (Ctrl-C ends it)")
    console.print(address, soft_wrap=True)


def _facts(scene: Viewable) -> list[str]:
    return [
        f"{scene.gaussians.num:,} Gaussians",
        *contents(scene),
        *(["can be queried"] if scene.asking else []),
    ]


def screenshots(folder: Path) -> Callable[[str, np.ndarray], Path]:
    """A function that saves pictures in a folder as NUMBER_KIND.png, with the next number; none is
    replaced."""

    def save(kind: str, picture: np.ndarray) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(found[1]) for file in folder.iterdir() if (found := _NUMBERED.match(file.name))]
        names = (folder / f"{number:04d}_{kind}.png" for number in count(max(numbers, default=0) + 1))
        return write_new(names, lambda path: write_png(path, picture))

    return save
