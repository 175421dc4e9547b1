"""`gsjax edit`: change when, where and how the parts of a run move, and film it."""

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import track

from gsjax.data.text import decoded
from gsjax.engine.folder import SCRIPT, is_nonempty
from gsjax.engine.locks import lock, releasing_locks
from gsjax.engine.messages import Notes, counted, stage
from gsjax.engine.options import Common, Overwriting
from gsjax.engine.parts.films import VIDEO, Shot, edited, most_changed_camera, new_folder, write_film
from gsjax.engine.parts.results import example_edit, table_of_parts
from gsjax.engine.parts.saved import open_parts_run
from gsjax.engine.terminal import print_table
from gsjax.io.parsed import parse_json
from gsjax.methods.parts.operation import Edit
from gsjax.methods.parts.operations import OPERATIONS, Composite
from gsjax.methods.parts.timeline import Names, Script, parse_op, parse_script

HELP = (
    f" Operations: {', '.join(OPERATIONS)}. A script is a YAML file, `edits: [{{op: speed, parts: [door], "
    "factor: 2}]`, which may also have fps and length (seconds)."
)
_UNNAMED = "ops"


@dataclass(frozen=True)
class Options(Common, Overwriting):
    """Options of `gsjax edit`."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax parts`."""
    script: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[SCRIPT]")] = None
    """A YAML file of edits."""
    op: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="OP:KEY=VALUE,...")] = ()
    """An edit, after those of the script: "speed:parts=drawer,factor=2"."""
    fps: float | None = None
    """Frames a second; default: those of the script, else of the recording."""
    length: float | None = None
    """Seconds; default: those of the script, else as long as the recording and the edits require."""
    out: Path | None = None
    """Folder for the film; default: RUN/edit/NAME, where NAME is the script's name or, without a script, ops,
    ops_2 and so on."""
    camera: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Id of the camera to film from; default: the one whose pictures the edits change most."""
    ply: bool = False
    """Write the Gaussians of each frame too, as ply/000000.ply and so on."""


@releasing_locks()
def run(options: Options) -> int:
    """Edit a run, and film the result; returns the exit code. A film stopped by Ctrl-C can be watched up to
    there. Without edits, list the parts.

    Raises:
        ValueError, OSError: there is no such run or part, or the edits cannot be read or applied.
    """
    if options.script is None and not options.op:
        return _list_parts(options.run)
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        script = read_script(options)
        if options.run.is_dir():
            lock(options.run, shared=True)
        saved = open_parts_run(options.run)
        given = None if options.camera is None else saved.camera(options.camera)
        with stage(console, "editing"):
            film, doubts = edited(script, saved)
        with stage(console, "looking for the camera that sees most of the edits"):
            camera = most_changed_camera(film, saved, script) if given is None else given
        folder = _folder(options)
        for doubt in doubts:
            notes.warn(doubt)

        def watch(frames: Iterable[Shot], asked: int) -> Iterable[Shot]:
            return track(frames, "rendering", asked, console=console, transient=True)

        found = write_film(folder, script, film, saved, camera, notes, watch=watch, ply=options.ply)
    asked, stopped = len(film[0].trajectory.times), found["stopped"]
    part = f" of {asked} (stopped by {stopped})" if stopped else ""
    pace = f"; rendered at {found['render_hz']:.1f} a second" if found["render_hz"] else ""
    frames = counted(found["frames"], "frame")
    print(f"{found['seconds']:.2f} s, {frames}{part}, seen by camera {camera}{pace}")
    print(f"edits   {'; '.join(_described(edit, saved.names) for edit in script.edits)}")
    print(f"film    {folder / VIDEO}")
    return 130 if stopped else 0


def _list_parts(run: Path) -> int:
    """Print the parts that can be edited."""
    with Notes(Console(stderr=True, highlight=False)):
        saved = open_parts_run(run)
    metrics = run / "metrics.json"
    if not metrics.is_file():
        raise FileNotFoundError(
            f"{run}: expected a scored run, found no metrics.json; finish it with --resume"
        )
    found = parse_json(metrics.read_text(encoding="utf-8"))
    print_table(table_of_parts(found))
    video = run / f"video_{saved.camera(None)}.mp4"
    if video.is_file():  # a run that was stopped has none
        print(f"where   {video}, and those of other cameras, in these colours")
    if found["parts"]:
        print(f"edit    {example_edit(shlex.quote(str(run)), found)}")
    return 0


def _described(edit: Edit, names: Names) -> str:
    """An edit in short, "freeze: drawer (2)"; parts of another run as in the script."""
    if isinstance(edit, Composite):
        return f"{edit.operation()}: {', '.join(map(str, edit.parts))} of {edit.from_run}"
    called = {number: name for name, number in names.items()}
    each = [names.get(part, part) if isinstance(part, str) else part for part in edit.parts]
    parts = [f"{called[part]} ({part})" if part in called else str(part) for part in each]
    return f"{edit.operation()}: {', '.join(parts)}"


def read_script(options: Options) -> Script:
    """The edits of the options.

    Raises:
        ValueError: one is invalid; the message names the file or option.
        OSError: the script cannot be read.
    """
    script = Script()
    if options.script is not None:
        try:
            text = decoded(options.script.read_bytes())
        except ValueError as error:
            raise ValueError(f"{options.script}: expected a YAML file of edits, found no text") from error
        try:
            script = parse_script(text)
        except ValueError as error:
            raise ValueError(f"{options.script}: {error}") from error
    edits = []
    for number, text in enumerate(options.op, len(script.edits) + 1):
        try:
            edits.append(parse_op(text, number))
        except ValueError as error:
            raise ValueError(f"--op {text!r}: {error}") from error
    given = {key: value for key in ("fps", "length") if (value := getattr(options, key)) is not None}
    try:
        return replace(script, edits=(*script.edits, *edits), **given)
    except ValueError as error:
        raise ValueError(f"--{error}") from error


def _folder(options: Options) -> Path:
    """The folder of the film.

    Raises:
        FileExistsError: it holds something that is no film, or a film that may not be replaced.
        BlockingIOError: another process writes into it.
        NotADirectoryError: it is a file.
    """
    if options.out is None and options.script is None and not options.overwrite:
        return new_folder(options.run / "edit", _UNNAMED)
    name = _UNNAMED if options.script is None else options.script.stem
    folder = options.run / "edit" / name if options.out is None else options.out
    lock(folder)
    if is_nonempty(folder):
        if not (folder / SCRIPT).is_file():
            raise FileExistsError(
                f"{folder}: expected a new or empty folder, or that of an earlier film (with "
                f"{SCRIPT}), found other files; choose another --out"
            )
        if not options.overwrite:
            raise FileExistsError(
                f"{folder}: holds an earlier film; name another --out, or replace it with --overwrite"
            )
    return folder
