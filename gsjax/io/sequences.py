"""Scenes that move as numbered files of Gaussians, one a frame, in any format: frames/%04d.ply.

Row i is the same Gaussian in every file. SuperSplat plays such a folder of .ply.
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.io.labels import ENDING
from gsjax.io.scene_file import spatial_order
from gsjax.io.scenes import READ, format_of, write_gaussians
from gsjax.scene.gaussians import Gaussians, valid_rows

_NUMBER = re.compile(r"%(?:0(\d))?d")
_NUMBERED = re.compile(rf"(.*?)(\d+)({'|'.join(map(re.escape, READ))})", re.I | re.S)


def is_numbered(path: str | os.PathLike) -> bool:
    """Whether a name stands for numbered files: it has %d, or %04d for four digits.

    Args:
        path: the name, such as frames/%04d.ply.
    """
    return _NUMBER.search(Path(path).name) is not None


def frame_path(path: str | os.PathLike, number: int) -> Path:
    """The file of a frame.

    Args:
        path: a name for which `is_numbered` is true.
        number: of the frame, from 0.
    """
    path = Path(path)
    return path.with_name(_NUMBER.sub(lambda found: f"{number:0{found[1] or 1}d}", path.name, count=1))


def frame_files(folder: str | os.PathLike) -> list[Path]:
    """The files of a folder that holds nothing but the numbered frames of one scene, by number; else none.

    There are two or more, whose names differ in a number before the ending. Labels beside them, hidden files
    and folders are passed over.

    Args:
        folder: the folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        return []
    files = [f for f in folder.iterdir() if f.is_file() and not f.name.startswith(".")]
    found = {file: _NUMBERED.fullmatch(file.name) for file in files if not file.name.endswith(ENDING)}
    names = {file: match.groups() for file, match in found.items() if match}
    if len(names) < 2 or len(names) < len(found) or len({(a, c.lower()) for a, _, c in names.values()}) > 1:
        return []
    return sorted(names, key=lambda file: (int(names[file][1]), file.name))


def write_frames(
    path: str | os.PathLike, frames: Iterable[tuple[int, Gaussians]], **options: Any
) -> tuple[str, ...]:
    """Write each frame of a scene that moves to a file of its own, each atomically; one that is there is
    replaced.

    Args:
        path: a name for which `is_numbered` is true, in any format but a page, which holds all frames itself.
        frames: number and Gaussians of each, in the same order in all.
        **options: further ones of `write_gaussians`.

    Returns:
        What was left out of some, each in a few words.

    Raises:
        ValueError: as for `write_gaussians`; or in some frame not all Gaussians can be drawn, or there are
            more or fewer than in the first.
    """
    written, order, left_out = format_of(path), None, {}
    for number, gaussians in frames:
        file = frame_path(path, number)
        if not valid_rows(gaussians).all():
            raise ValueError(f"{file}: expected Gaussians that can all be drawn, found some that cannot")
        if order is None:
            order = spatial_order(np.asarray(gaussians.means, np.float64))
        if len(order) != gaussians.num:
            raise ValueError(f"{file}: expected {len(order)} Gaussians as before, found {gaussians.num}")
        known = {"order": order} if "order" in written.options else {}
        left_out |= dict.fromkeys(write_gaussians(file, gaussians, **known, **options))
    return tuple(left_out)
