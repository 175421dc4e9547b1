"""Scenes that move as numbered files of Gaussians, one a frame, in one folder: frame_0000.ply, ..."""

import os
import re
from pathlib import Path

from gsjax.io.labels import ENDING
from gsjax.io.scenes import READ

_BESIDE = (ENDING, ".txt", ".md", ".log")
_NUMBERED = re.compile(rf"(.*?)(\d+)({'|'.join(map(re.escape, READ))})", re.I | re.S)


def frame_files(folder: str | os.PathLike) -> list[Path]:
    """The files of a folder that holds nothing but the numbered frames of one scene, by number; else none.

    There are two or more, whose names differ in a number before the ending. Labels and texts (.txt, .md,
    .log, without an ending) beside them, hidden files and folders are passed over.

    Args:
        folder: the folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return []
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    files = [file for file in files if file.suffix and not file.name.lower().endswith(_BESIDE)]
    found = {file: _NUMBERED.fullmatch(file.name) for file in files}
    names = {file: match.groups() for file, match in found.items() if match}
    kinds = {(before, ending.lower()) for before, _, ending in names.values()}
    if len(names) < 2 or len(names) < len(found) or len(kinds) > 1:
        return []
    return sorted(names, key=lambda file: (int(names[file][1]), file.name))
