"""Scenes that move as numbered files of Gaussians, one a frame, in one folder: frame_0000.ply, ..."""

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from gsjax.io.brief import brief
from gsjax.io.labels import ENDING
from gsjax.io.scenes import READ

_PHOTOGRAPHS = (".jpg", ".jpeg", ".png")
_LISTED, _QUOTED = 3, 100  # names in a message, and characters of each
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


def missing_numbers(files: Sequence[Path]) -> list[int]:
    """The numbers that some frames lack, where the others follow each other in even steps.

    Args:
        files: from `frame_files`.
    """
    matches = [_NUMBERED.fullmatch(file.name) for file in files]
    numbers = [int(match[2]) for match in matches if match]
    steps = [after - before for before, after in pairwise(numbers)]
    usual = max(1, min(steps, default=1))
    if any(step % usual for step in steps) or numbers[-1] - numbers[0] > 2 * usual * len(numbers):
        return []
    return sorted({*range(numbers[0], numbers[-1], usual)} - {*numbers})


def scenes_within(folder: str | os.PathLike) -> str:
    """In words, the files of Gaussians in a folder that is no scene by itself, and what they lie beside; ""
    if there are none, or as many photographs.

    Args:
        folder: the folder.
    """
    files = sorted(file for file in Path(folder).iterdir() if file.is_file() and file.name[0] != ".")
    scenes = [file.name for file in files if file.name.lower().endswith(READ)]
    others = [file.name for file in files if not file.name.lower().endswith((*READ, *_BESIDE))]
    if len(scenes) <= sum(name.lower().endswith(_PHOTOGRAPHS) for name in others):
        return ""
    count = "a file" if len(scenes) == 1 else f"{len(scenes)} files"
    beside = f" beside {_some(others)}" if others else ""
    return f"{count} of Gaussians ({_some(scenes)}){beside}"


def _some(names: list[str]) -> str:
    return ", ".join(brief(name, _QUOTED) for name in names[:_LISTED]) + ", ..." * (len(names) > _LISTED)
