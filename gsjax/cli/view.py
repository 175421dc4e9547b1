"""`gsjax view`: a run or a PLY file in a web browser."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
import yaml
from rich.console import Console

from gsjax.cli.messages import Notes, say_error, stage
from gsjax.cli.outputs import write_png
from gsjax.cli.photographs import photographs_of_run
from gsjax.cli.run_folder import expect_run
from gsjax.cli.saved_run import SavedRun, open_run, read_tracking
from gsjax.data.photographs import Photographs
from gsjax.io.ply import read_ply
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.colors import to_uint8
from gsjax.viz.viewer import Shots, Viewable, Viewer, open_viewer
from gsjax.viz.viewer.server import PORT, is_loopback, load_viser

_UP = {sign + axis: s * np.eye(3)[i] for sign, s in (("", 1), ("-", -1)) for i, axis in enumerate("xyz")}
_NUMBERED = re.compile(r"(\d+)_")


@dataclass(frozen=True)
class Options:
    """What `gsjax view` is told."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE.ply")]
    """Folder of a run of `gsjax fit` or `gsjax track`, or a PLY file of Gaussians."""
    host: str = "127.0.0.1"
    """Address to listen on. Only this machine can look unless it is another than the default."""
    port: int | None = None
    """Port to listen on. 8080, or the next one that is free, unless given."""
    max_gaussians: int = 500_000
    """The browser gets so many Gaussians at most, the most opaque ones; our render has all."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = "auto"
    """Which way is up; as photographs were held, else z, unless given."""
    debug: bool = False
    """Show Python's traceback when something fails."""


def run(options: Options) -> int:
    """Show it until Ctrl-C, whose exit code it returns.

    Raises:
        ValueError, OSError: there is nothing to look at, or nothing can listen at that address.
    """
    try:
        load_viser()
    except ImportError as error:
        raise ValueError(str(error)) from error
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            scene, folder = open_viewable(options.path, notes)
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
    count = scene.gaussians.num
    if count > options.max_gaussians:
        notes.warn(
            f"the browser gets the {options.max_gaussians} most opaque of {count} Gaussians "
            "(--max-gaussians); our render has all"
        )
    if options.port is None and viewer.port != PORT:
        notes.warn(f"port {PORT} is in use; this is {viewer.port} (--port names one)")
    if not is_loopback(options.host):
        notes.warn(
            f"--host {options.host}: everyone who reaches this machine over the network can look, and save "
            "screenshots here; there is no password"
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
    return ", ".join(told)


def open_viewable(path: Path, notes: Notes) -> tuple[Viewable, Path]:
    """What there is to see, and the folder that screenshots belong to.

    Raises:
        FileNotFoundError: there is no such file, or the folder is no run with a scene.
        ValueError: the file holds no Gaussians, or something else than a run writes.
    """
    if path.is_file():
        if path.suffix.lower() != ".ply":
            raise ValueError(f"{path}: expected a PLY file or the folder of a run, found another file")
        gaussians, labels = _read(path, notes)
        return Viewable(path.name, gaussians, labels), path.absolute().parent
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: expected a run or a PLY file, found nothing there; check the path")
    expect_run(path)
    if not (path / "scene.ply").is_file():
        raise FileNotFoundError(
            f"{path}: expected a run with scene.ply, found none: it is not finished, or of a command that "
            "keeps no scene; let `gsjax fit` or `gsjax track` finish (--resume goes on)"
        )
    tracked = (path / "trajectory.npz").is_file()
    return (_of_track if tracked else _of_fit)(path, notes), path


def _of_fit(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax fit`, with its photographs where they still are."""
    gaussians, labels = _read(path / "scene.ply", notes)
    config = path / "config.yml"
    try:
        settings = yaml.safe_load(config.read_text(encoding="utf-8"))
        antialiased = bool(settings["fit"]["antialiased"])
        behind = settings["fit"]["background"]
        shots, photographs = None, None
        try:
            photographs = photographs_of_run(settings)
            shots = _shots_of(photographs)
        except (ValueError, OSError) as error:
            notes.warn(f"its photographs are not shown: {error}")
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{config}: expected the settings of a fit, found others ({error})") from error
    background = photographs.background if photographs is not None and behind == "data" else None
    if background is None:
        background = (1.0, 1.0, 1.0) if behind == "white" else (0.0, 0.0, 0.0)
    title = path.absolute().name
    return Viewable(title, gaussians, labels, shots=shots, background=background, antialiased=antialiased)


def _of_track(path: Path, notes: Notes) -> Viewable:
    """The scene of a run of `gsjax track` over time, with its cameras where its recording still is."""
    names: dict[int, str] = {}
    shots, times = None, None
    try:
        saved = open_run(path)
    except ValueError as error:
        tracking = read_tracking(path)  # what is damaged there is an error
        notes.warn(f"its recording is not shown: {error}")
    else:
        tracking, names = saved.tracking, saved.names
        recording = saved.recording.judged
        shots, times = _shots_of_recording(saved), recording.times[: tracking.num_frames]
    count = tracking.scene.num_moving
    return Viewable(
        path.absolute().name,
        tracking.scene.gaussians,
        np.asarray(tracking.scene.labels),
        names,
        means=tracking.means()[:, :count],
        quats=tracking.quats(),
        times=times,
        shots=shots,
        unit="m",
    )


def _read(path: Path, notes: Notes) -> tuple[Gaussians, np.ndarray | None]:
    """The Gaussians of a file, and their labels.

    Raises:
        ValueError: it holds none.
    """
    gaussians, report = read_ply(path)
    if report.culled:
        notes.warn(f"{path}: {report.culled} of {report.stored} Gaussians cannot be drawn and are left out")
    if gaussians.num == 0:
        raise ValueError(f"{path}: expected Gaussians, found none that can be drawn")
    return gaussians, report.labels


def _shots_of(photographs: Photographs) -> Shots:
    return Shots(
        photographs.names,
        photographs.viewmats[None],
        photographs.Ks[None],
        photographs.sizes,
        load_image=lambda _, v: photographs.image(v),
    )


def _shots_of_recording(saved: SavedRun) -> Shots:
    sequence, frames = saved.recording.judged, saved.tracking.num_frames
    held_out = saved.recording.held_out
    names = [f"camera {c}" + (" (held out)" if c in held_out else "") for c in sequence.camera_ids]
    return Shots(
        tuple(names),
        sequence.viewmats[:frames],
        sequence.Ks[:frames],
        np.tile([sequence.width, sequence.height], (len(names), 1)),
        load_image=lambda t, v: to_uint8(np.asarray(sequence.image(t, v))),
    )


def screenshots(folder: Path) -> Callable[[str, np.ndarray], Path]:
    """Keeps pictures in a folder as NUMBER_KIND.png, numbered on; none is written over."""

    def save(kind: str, picture: np.ndarray) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(found[1]) for file in folder.iterdir() if (found := _NUMBERED.match(file.name))]
        number = max(numbers, default=0)
        while True:
            number += 1
            path = folder / f"{number:04d}_{kind}.png"
            try:
                path.open("x").close()  # the number is ours, whoever else saves here
                break
            except FileExistsError:
                continue
        try:
            write_png(path, picture)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
        return path

    return save
