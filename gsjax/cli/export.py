"""`gsjax export`: the Gaussians of a run or a file in another format, as a file for each frame, or as a page
that shows or plays them."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.text import Text

from gsjax.engine.folder import is_of_run
from gsjax.engine.messages import Notes, counted, reason, stage
from gsjax.engine.options import Common
from gsjax.engine.recording import parse_frames
from gsjax.engine.show import files_of, page_options
from gsjax.engine.terminal import format_bytes
from gsjax.engine.viewables import UP, Up, open_viewable
from gsjax.io.labels import labels_beside
from gsjax.io.scene_file import spatial_order
from gsjax.io.scenes import FORMATS, Format, format_of, write_gaussians
from gsjax.io.sequences import frame_files
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.viewer import Viewable

HELP = (
    " The ending of OUT names the format: .ply (3DGS), .compressed.ply (PlayCanvas), .splat, .spz (Niantic), "
    ".sog (PlayCanvas), .glb (glTF with KHR_gaussian_splatting), or .html, a page that opens from disk. Of a "
    "run that moves, a page plays all frames, 'frame_####.ply' writes each to a file of its number, and "
    "other names are of its first."
)
_NUMBER = re.compile("#+")


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax export`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE|FOLDER")]
    """Folder of a run of `gsjax fit`, `track`, `parts` or `deform`, or of a film of `gsjax edit`; a file of
    Gaussians: .ply, .compressed.ply, .splat, .spz, .sog or .ksplat; or a folder of numbered ones, the frames
    of a scene."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write. Where its name has a run of #, as in 'frame_####.ply', a file is written for each
    frame of a run that moves, with the number of the frame in place of it."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP[:STEP]")] = None
    """Frames of a run that moves, counted from 0. Default: all."""
    up: Up = "auto"
    """The up direction of a page; auto: that of a run's photographs, else -y, as in most files."""
    overwrite: bool = False
    """Replace OUT if it is there."""


def run(options: Options) -> int:
    """Write the file or files; returns the exit code.

    Raises:
        ValueError, OSError: there is no such scene or frame, no format of that ending, or OUT is there
            already.
    """
    written = format_of(options.out)
    numbered = _NUMBER.search(options.out.name) is not None
    if len(_NUMBER.findall(options.out.name)) > 1:
        raise ValueError(f"{options.out}: expected one run of # for the number of the frame, found several")
    _check(options, options.out)
    if options.up != "auto" and "up" not in written.options:
        raise ValueError(f"--up: expected OUT to be a page (.html), found {options.out}; leave it out")
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            scene, _ = open_viewable(options.path, notes, photographs="view" in written.options)
        rows = _chosen(options.frames, scene.num_frames)
        look: dict[str, Any] = {"antialiased": scene.antialiased, "origin": scene.origin}
        look["labels"] = None if scene.labels is None else np.asarray(scene.labels)
        if "up" in written.options:
            shown = rows[:1] if numbered else rows  # one page per frame shows only that frame
            look |= page_options(scene, shown, options.path)
            if options.up != "auto":
                look["up"] = UP[options.up].tolist()
        if numbered:
            return _write_frames(options, scene, rows, look, notes, console)
        moves, plays = len(rows) > 1 and scene.num_moving > 0, "film" in look
        if moves and not plays:
            notes.warn(
                f"{options.path} moves; only its first of {len(rows)} frames is written. A page (.html) "
                f"plays all, and 'frame_####{_ending(written)}' writes a file for each"
            )
        with stage(console, f"writing {options.out}"):
            left_out = write_gaussians(options.out, _at(scene, rows[0]), **look)
        _warn(notes, options.out, written, left_out)
    text = f"{scene.gaussians.num:,} Gaussians, {written.name}{f' of {len(rows)} frames' if plays else ''}"
    _tell(options.out, f"{text}, {format_bytes(options.out.stat().st_size)}")
    return 0


def _write_frames(
    options: Options, scene: Viewable, rows: range, look: dict[str, Any], notes: Notes, console: Console
) -> int:
    """Write a file for each frame, until Ctrl-C; returns the exit code."""
    written, sizes, stopped = format_of(options.out), [], None
    files = [_numbered(options.out, row) for row in rows]
    for file in files:
        _check(options, file)
    if "order" in written.options:  # so that each row is the same Gaussian in every file
        look["order"] = spatial_order(np.asarray(_at(scene, rows[0]).means, np.float64))
    frames: Iterable[tuple[int, Path]] = list(zip(rows, files, strict=True))
    try:
        for row, file in track(frames, "writing", console=console, transient=True):
            left_out = write_gaussians(file, _at(scene, row), **look)
            _warn(notes, options.out, written, left_out)
            sizes.append(file.stat().st_size)
    except KeyboardInterrupt as interrupt:
        stopped = reason(interrupt)
    if others := set(frame_files(options.out.parent)) - set(files):
        notes.warn(
            f"{options.out.parent} holds {len(others)} more numbered files, such as {min(others).name}, "
            "which programs take for frames of the same scene"
        )
    part = "" if stopped is None else f" of {len(files)} (stopped by {stopped})"
    text = f"{counted(len(sizes), 'file')}{part} of {scene.gaussians.num:,} Gaussians, {written.name}"
    _tell(options.out, f"{text}, {format_bytes(sum(sizes))}")
    return 0 if stopped is None else 130


def _numbered(out: Path, number: int) -> Path:
    """The file of a frame."""
    return out.with_name(_NUMBER.sub(lambda found: str(number).zfill(len(found[0])), out.name))


def _chosen(frames: str | None, count: int) -> range:
    """The frames that are written.

    Raises:
        ValueError: there are none, or `frames` is no slice.
    """
    rows = range(count)[slice(None) if frames is None else parse_frames(frames)]
    if not rows:
        raise ValueError(f"--frames: {frames} selects no frame of the scene, which has {count}")
    return rows


def _at(scene: Viewable, row: int) -> Gaussians:
    return scene.gaussians if scene.motion is None else scene.at(row)


def _check(options: Options, out: Path) -> None:
    """Raises an OSError where a file must not be written."""
    if out.is_dir():
        raise IsADirectoryError(
            f"{out}: expected a file, found a folder; name one in it that ends in {', '.join(FORMATS)}"
        )
    if out.exists() and out.resolve() in files_of(options.path):
        raise FileExistsError(f"{out}: expected another file than the one that is read; name another OUT")
    if is_of_run(out):
        raise FileExistsError(f"{out}: expected another file than one that a run wrote; name another OUT")
    for file in (out, labels_beside(out)) if "labels" in format_of(out).options else (out,):
        if file.exists() and not options.overwrite:
            raise FileExistsError(
                f"{file}: is there already; name another OUT, or replace it with --overwrite"
            )


def _ending(written: Format) -> str:
    return next(ending for ending, each in FORMATS.items() if each is written)


def _warn(notes: Notes, out: Path, written: Format, left_out: tuple[str, ...]) -> None:
    for what in left_out:
        notes.warn(f"{out}: {written.name} leaves out {what}")


def _tell(out: Path, text: str) -> None:
    Console(highlight=False).print(Text.assemble(("scene", "bold"), f"  {out}: {text}"), soft_wrap=True)
