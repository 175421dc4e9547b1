"""Moving scenes as numbered files of Gaussians in one folder, one per frame: frame_0000.ply, ..."""

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from gsjax.io.brief import shortened
from gsjax.io.labels import ENDING
from gsjax.io.scenes import READ

_HEADER = 2**16  # bytes
_BESIDE = (ENDING, ".txt", ".md", ".log")
_NUMBERED = re.compile(rf"(.*?)(\d+)({'|'.join(map(re.escape, READ))})", re.I | re.S)


def frame_files(folder: str | os.PathLike) -> list[Path]:
    """The files of a folder that holds only the numbered frames of one scene, in order; otherwise none.

    There are two or more, whose names differ in a number before the ending. Labels and texts (.txt, .md,
    .log, without an ending) beside them, hidden files and folders are ignored.

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
    """The numbers missing from a sequence of frames that is otherwise numbered in even steps.

    Args:
        files: two or more, from `frame_files`.
    """
    matches = [_NUMBERED.fullmatch(file.name) for file in files]
    numbers = [int(match[2]) for match in matches if match]
    steps = [after - before for before, after in pairwise(numbers)]
    usual = max(1, min(steps, default=1))
    if any(step % usual for step in steps) or sum(steps) > 2 * usual * len(numbers):
        return []
    return [n + usual * k for n, step in zip(numbers, steps, strict=False) for k in range(1, step // usual)]


def scenes_within(folder: str | os.PathLike) -> list[Path]:
    """The files of Gaussians in a folder, for messages about a folder that is not itself a scene.

    Args:
        folder: the folder.
    """
    return sorted(file for file in Path(folder).iterdir() if file.is_file() and _holds_gaussians(file))


def scenes_in_words(scenes: Sequence[Path]) -> str:
    """Files of Gaussians, and the files beside them, in words.

    Args:
        scenes: from `scenes_within`, at least one.
    """
    files = sorted(file.name for file in scenes[0].parent.iterdir() if file.is_file())
    names = [file.name for file in scenes]
    others = [n for n in files if n not in names and n[0] != "." and not n.lower().endswith(_BESIDE)]
    count = "a file" if len(names) == 1 else f"{len(names)} files"
    beside = f" beside {shortened(others)}" if others else ""
    return f"{count} of Gaussians ({shortened(names)}){beside}"


def _holds_gaussians(file: Path) -> bool:
    """Whether a file holds Gaussians, by its ending and, since PLY holds other things too, its header."""
    name = file.name.lower()
    if name[0] == "." or not name.endswith(READ):
        return False
    if not name.endswith(".ply"):
        return True
    with file.open("rb") as stream:
        header = stream.read(_HEADER).partition(b"end_header")[0]
    return b" f_dc_0" in header or b" packed_" in header
