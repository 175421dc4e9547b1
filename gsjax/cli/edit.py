"""`gsjax edit`: changes when, where and how parts of a run move, and films it."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from gsjax.cli.machine import describe as describe_machine
from gsjax.cli.messages import Notes
from gsjax.cli.parts_run import PartsRun, open_parts_run, read_parts
from gsjax.geometry.cameras import Camera
from gsjax.io.atomic import atomic_write, write_json
from gsjax.io.ply import write_ply
from gsjax.io.video import VideoWriter
from gsjax.methods.motion_parts.film import Film, film_gaussians
from gsjax.methods.motion_parts.limits import beyond_captured, describe_beyond
from gsjax.methods.motion_parts.operations import OPERATIONS
from gsjax.methods.motion_parts.timeline import Script, apply, parse_op, parse_script, to_yaml
from gsjax.optim.compiler import host_options
from gsjax.scene.gaussians import Gaussians
from gsjax.scene.render import render_with_room

HELP = (
    f" Operations: {', '.join(OPERATIONS)}. A script is a YAML file, `edits: [{{op: speed, parts: [door], "
    "factor: 2}]`, which may also have fps and length (seconds)."
)
_SCRIPT, _VIDEO, _METRICS, _PLY = "edit.yaml", "video.mp4", "metrics.json", "ply"


@dataclass(frozen=True)
class Options:
    """What `gsjax edit` is told."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax parts`."""
    script: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCRIPT]")] = None
    """A YAML file of edits."""
    op: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="OP:KEY=VALUE,...")] = ()
    """One edit, after those of the script: "speed:parts=drawer,factor=2". Can be given again and again."""
    out: Path | None = None
    """Folder for the film. RUN/edit/NAME unless given, NAME being the script's, or "ops" without one."""
    camera: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Id of the camera to film from. The first held out one, else the first, unless given."""
    ply: bool = False
    """Write the Gaussians of each frame of the film too, as ply/000000.ply and so on."""
    overwrite: bool = False
    """Replace an earlier film in the same folder."""
    debug: bool = False
    """Show Python's traceback when something fails."""


class Shot(NamedTuple):
    """A frame of a film.

    Attributes:
        image: as the camera sees it.
        gaussians: what is there.
        seconds: that both took; None where something was compiled.
    """

    image: Float[np.ndarray, "height width 3"]
    gaussians: Gaussians
    seconds: float | None


def run(options: Options) -> int:
    """Edit, and film what comes of it; returns the exit code. Of a film that Ctrl-C stops, what there is
    can be watched.

    Raises:
        ValueError, OSError: there is no such run or part, or the edits cannot be read or done.
    """
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        script = read_script(options)
        saved = open_parts_run(options.run)
        camera = saved.camera(options.camera)
        folder = _folder(options)
        with console.status("editing"):
            film = apply(script, saved.layer, saved.names, read_parts)
            _warn(saved, film, notes)
        _clear(folder)
        with atomic_write(folder / _SCRIPT) as temporary:
            temporary.write_text(to_yaml(script), encoding="utf-8")
        sequence = saved.recording.judged
        view = sequence.camera(0, sequence.camera_ids.index(camera))
        fps = script.fps or 1 / float(np.median(np.diff(saved.recording.tracked.times)))
        asked, seconds, stopped = len(film[0].trajectory.times), [], False
        with VideoWriter(folder / _VIDEO, fps) as video:
            try:
                for shot in track(
                    shots(film, view, saved), "rendering", asked, console=console, transient=True
                ):
                    if options.ply:
                        write_ply(folder / _PLY / f"{len(seconds):06d}.ply", shot.gaussians)
                    video.write(shot.image)
                    seconds.append(shot.seconds)
            except KeyboardInterrupt:
                stopped = True
                notes.add(f"This film is not complete: it was stopped after {len(seconds)} frames by Ctrl-C.")
        warm = [each for each in seconds if each is not None]
        found = {
            "kind": "edit",
            "dataset": sequence.name,
            "run": str(saved.path.absolute()),
            "complete": not stopped,
            "camera": camera,
            "frames": len(seconds),
            "fps": fps,
            "seconds": len(seconds) / fps,
            "num_gaussians": sum(layer.scene.gaussians.num for layer in film),
            "render_hz": 1 / float(np.median(warm)) if warm else None,
            "machine": describe_machine(),
            "notes": notes.all,
        }
        write_json(folder / _METRICS, found)
    part = f" of {asked} (stopped by Ctrl-C)" if stopped else ""
    pace = f"; rendered at {found['render_hz']:.1f} a second" if warm else ""
    print(f"{found['seconds']:.2f} s, {len(seconds)} frames{part}, seen by camera {camera}{pace}")
    print(f"film    {folder}")
    return 130 if stopped else 0


def read_script(options: Options) -> Script:
    """The edits that are asked for.

    Raises:
        ValueError: there are none, or they are not as they should be; the message names the file or option.
        OSError: the script cannot be read.
    """
    if options.script is None and not options.op:
        raise ValueError(
            'SCRIPT: expected a YAML file of edits, or --op "speed:parts=1,factor=2"; found neither'
        )
    script = Script()
    if options.script is not None:
        try:
            script = parse_script(options.script.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{options.script}: {error}") from error
    edits = []
    for text in options.op:
        try:
            edits.append(parse_op(text))
        except ValueError as error:
            raise ValueError(f"--op {text!r}: {error}") from error
    return replace(script, edits=(*script.edits, *edits))


def shots(film: Film, camera: Camera, saved: PartsRun) -> Iterator[Shot]:
    """A film as a camera sees it, frame by frame."""
    placed = jax.jit(film_gaussians, static_argnames="blend", compiler_options=host_options())
    cameras, plan = jax.tree.map(lambda leaf: leaf[None], camera), None
    for t in range(len(film[0].trajectory.times)):
        begun, before = perf_counter(), plan
        gaussians = placed(film, jnp.asarray(t), blend=saved.blend)
        drawn, plan = render_with_room(gaussians, cameras, plan)
        image = np.clip(np.asarray(drawn.colors[0]), 0, 1)
        yield Shot(image, gaussians, perf_counter() - begun if plan is before else None)


def _warn(saved: PartsRun, film: Film, notes: Notes) -> None:
    """Say what makes the film doubtful."""
    if not saved.complete:
        frames = len(saved.layer.trajectory.times)
        notes.warn(f"{saved.path} is a partial run: only {frames} of its frames are there")
    edited = film[0].trajectory
    beyond = describe_beyond(beyond_captured(saved.layer, edited), edited.times, saved.names)
    if beyond:  # as one, for those of two parts differ in numbers only, and one would not be shown
        notes.warn(". ".join(beyond))


def _folder(options: Options) -> Path:
    """Where the film goes.

    Raises:
        FileExistsError: something is there that is no film, or one that may not be replaced.
        NotADirectoryError: it is a file.
    """
    name = "ops" if options.script is None else options.script.stem
    folder = options.run / "edit" / name if options.out is None else options.out
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(f"{folder}: expected a folder, found a file; name another --out")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / _SCRIPT).is_file():
            raise FileExistsError(
                f"{folder}: expected a new folder, an empty one or one of an earlier film (which has "
                f"{_SCRIPT}), found other files; name another --out"
            )
        if not options.overwrite:
            raise FileExistsError(
                f"{folder}: holds an earlier film; name another --out, or replace it with --overwrite"
            )
    return folder


def _clear(folder: Path) -> None:
    """Removes what an earlier film left there."""
    for name in (_SCRIPT, _VIDEO, _METRICS):
        (folder / name).unlink(missing_ok=True)
    if (folder / _PLY).is_dir():
        shutil.rmtree(folder / _PLY)
