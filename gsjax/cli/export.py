"""`gsjax export`: the Gaussians of a run or a file in another format, or as a page that shows them.

A scene that moves is written as numbered files, or as a page that plays.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import Common, Frames
from gsjax.engine.recording import parse_frames
from gsjax.engine.viewables import UP, Up, open_viewable
from gsjax.io.page import Film
from gsjax.io.scenes import FORMATS, Format, format_of, write_gaussians
from gsjax.io.sequences import frame_files, frame_path, is_numbered, write_frames
from gsjax.scene.gaussians import Gaussians
from gsjax.viz.viewer import Viewable
from gsjax.viz.viewer.cameras import scene_up
from gsjax.viz.viewer.player import frame_pause

HELP = (
    " The ending of OUT names the format: .ply (3DGS), .compressed.ply (PlayCanvas), .splat, .spz (Niantic), "
    ".sog (PlayCanvas), .glb (glTF with KHR_gaussian_splatting), or .html, a page that opens from disk, and "
    "plays a scene that moves. With %04d in its name, as in frames/%04d.ply, each frame is a file of its own."
)


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax export`."""

    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|FILE|FOLDER")]
    """Folder of a run of `gsjax fit`, `track`, `parts` or `deform`; a file of Gaussians: .ply,
    .compressed.ply, .splat, .spz, .sog or .ksplat; or a folder of numbered ones, the frames of a scene."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write; with %04d, or %d, in its name, the files of the frames by their numbers."""
    frames: Frames = ":"
    """Frames to write, as a Python slice: 0:60, 0:60:2, :30; 4:5 is the fifth alone. A file that holds one
    frame has the first of them."""
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
    written, numbered = format_of(options.out), is_numbered(options.out)
    chosen = parse_frames(options.frames)
    _check(options, written)
    console = Console(stderr=True, highlight=False)
    with Notes(console) as notes:
        with stage(console, f"reading {options.path}"):
            scene, _ = open_viewable(options.path, notes)
        frames = range(scene.num_frames)[chosen]
        if not frames:
            found = f"--frames {options.frames}: expected some of the {scene.num_frames} frames of"
            raise ValueError(f"{found} {options.path}, found none")
        if numbered and scene.num_frames == 1:
            raise ValueError(
                f"{options.out}: has a place for numbers, and {options.path} stands still; leave it out"
            )
        files = [frame_path(options.out, frame) for frame in frames] if numbered else [options.out]
        _expect_new(files, options)
        if len(frames) > 1 and not numbered and "film" not in written.options:
            notes.warn(
                f"{options.path} moves; only frame {frames[0]} of {scene.num_frames} is written (--frames "
                "chooses another; a page plays all, and %04d in the name makes a file of each)"
            )
        known = {"antialiased": scene.antialiased, "origin": scene.origin}
        with stage(console, f"writing {options.out}"):
            if numbered:
                left_out = write_frames(options.out, ((f, _at(scene, f)) for f in frames), **known)
            else:
                look = _look(options, scene, frames) if "up" in written.options else {}
                left_out = write_gaussians(options.out, _at(scene, frames[0]), **known, **look)
        for what in left_out:
            notes.warn(f"{options.out}: {written.name} leaves out {what}")
        if numbered and (others := set(frame_files(options.out.parent)) - set(files)):
            notes.warn(
                f"{options.out.parent} holds {len(others)} more numbered files, such as {min(others).name}, "
                "which programs take for frames of the same scene"
            )
    size = sum(file.stat().st_size for file in files)
    text = f"{scene.gaussians.num:,} Gaussians, {written.name}, {_megabytes(size)}"
    if len(frames) > 1 and (numbered or "film" in written.options):
        text = f"{len(frames)} frames of {text}"
    Console(highlight=False).print(f"[bold]scene[/]  {options.out}: {text}", soft_wrap=True)
    return 0


def _at(scene: Viewable, frame: int) -> Gaussians:
    """A frame, with features, of which is said that they are left out."""
    return scene.gaussians if scene.motion is None else scene.motion.at(frame)


def _look(options: Options, scene: Viewable, frames: range) -> dict[str, Any]:
    """What a page has of its own."""
    known = UP["-y"] if scene.up is None and scene.shots is None else scene_up(scene)
    up = known if options.up == "auto" else UP[options.up]
    look = {"up": up.tolist(), "background": scene.background}
    if len(frames) == 1:
        return look
    times = np.arange(scene.num_frames) * frame_pause(None) if scene.times is None else scene.times
    return look | {"film": Film(lambda row: scene.at(frames[row]), times[list(frames)], scene.num_moving)}


def _check(options: Options, written: Format) -> None:
    """Raises a ValueError or OSError where OUT cannot be written, whatever is read."""
    out = options.out
    if options.up != "auto" and "up" not in written.options:
        raise ValueError(f"--up: expected OUT to be a page (.html), found {out}; leave it out")
    if is_numbered(out) and "film" in written.options:
        raise ValueError(
            f"{out}: expected one page, which plays all frames, found a place for numbers; leave it out"
        )
    if out.is_dir():
        raise IsADirectoryError(
            f"{out}: expected a file, found a folder; name one in it that ends in {', '.join(FORMATS)}"
        )
    _expect_new([out], options)  # before anything is read


def _expect_new(files: list[Path], options: Options) -> None:
    """Raises a FileExistsError where a file must not be replaced."""
    there = [file for file in files if file.exists()]
    read = {file.resolve() for file in frame_files(options.path) or [options.path]}
    for file in there:
        if file.resolve() in read:
            raise FileExistsError(
                f"{file}: expected another file than the one that is read; name another OUT"
            )
    if there and not options.overwrite:
        raise FileExistsError(
            f"{there[0]}: is there already; name another OUT, or replace it with --overwrite"
        )


def _megabytes(size: int) -> str:
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
