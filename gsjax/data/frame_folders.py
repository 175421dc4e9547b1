"""Folders whose pictures are the frames of a recording, in order of their names."""

import re
import warnings
from itertools import pairwise
from pathlib import Path

from gsjax.data.errors import COMPLETE, DataError, DataWarning
from gsjax.data.files import picture_size
from gsjax.data.pictures import SUFFIXES, is_picture, reject_unread

DEFAULT_RATE_HZ = 30.0
"""Frame rate assumed if the data has no times."""

_NUMBER = re.compile(r"(\d+)")


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key by which frame_2 comes before frame_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in _NUMBER.split(name)]


def pictures(folder: Path) -> list[Path]:
    """The pictures in a folder, sorted by name; none if it does not exist.

    Warns with DataWarning if there are also pictures in a format that is not read.

    Raises:
        DataError: there are pictures, but none in a format that is read.
    """
    files = [path for path in folder.iterdir() if path.is_file()] if folder.is_dir() else []
    found = sorted(path for path in files if is_picture(path))
    reject_unread(folder, "pictures", files, others=len(found))
    return found


def pictures_beside(folder: Path, count: int, frames: str) -> list[Path]:
    """One picture per frame, such as the masks or depth images of a recording, sorted by name.

    Args:
        folder: the folder of the pictures.
        count: the number of frames.
        frames: name of the frames' folder or file, for messages.

    Raises:
        DataError: the number of pictures is not `count`, or their names sort differently than their numbers.
    """
    found = pictures(folder)
    if len(found) != count:
        expected = f"{count} pictures, one per frame of {frames}"
        advice = f"{COMPLETE} Pictures are paired in order of name."
        raise DataError(folder, expected, f"{len(found)}", advice)
    frame_numbers(found)  # an error if they would be paired with the wrong frames
    return found


def numbered(folder: Path, suffixes: tuple[str, ...] = SUFFIXES) -> dict[int, Path]:
    """The pictures in a folder whose names are numbers, by number; none if it does not exist.

    Args:
        folder: the folder.
        suffixes: extensions, in lower case.

    Raises:
        DataError: two pictures have the same number.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() in suffixes and path.stem.isdecimal():
            first = found.setdefault(int(path.stem), path)
            if first != path:
                names = f"{first.name} and {path.name}"
                raise DataError(folder, "one picture of each number", names, "Remove one of them.")
    return found


def frame_numbers(frames: list[Path]) -> tuple[int, ...]:
    """The last number in each name (12 for frame-000012_color.png); or positions from 0 if a name has no
    number, or these do not increase, as in 19.80.png and 20.20.png.

    Args:
        frames: files, sorted by name.

    Raises:
        DataError: names sort differently than their numbers, so the frames would be out of order in time.
    """
    found = [_NUMBER.findall(path.stem) for path in frames]
    numbers = tuple(int(texts[-1]) for texts in found if texts)
    if len(numbers) == len(frames) and all(a < b for a, b in pairwise(numbers)):
        return numbers
    for before, after in pairwise(frames):
        if natural_key(after.name) < natural_key(before.name):
            advice = "Pad the numbers with zeros to equal length."
            order = f"{after.name} after {before.name}"
            raise DataError(after.parent, "names that sort in the order of their numbers", order, advice)
    return tuple(range(len(frames)))


def warn_about_single_frame(frames: list[Path]) -> None:
    """Warns with DataWarning if there is only one frame."""
    if len(frames) == 1:
        message = f"{frames[0]}: it is the only frame, so no motion can be observed; give more frames"
        warnings.warn(message, DataWarning, stacklevel=3)


def check_one_size(frames: list[Path]) -> tuple[int, int]:
    """The common width and height of the frames, from their file headers.

    Raises:
        DataError: a file is not a picture, or differs in size from the first.
    """
    first = picture_size(frames[0])
    for path in frames[1:]:
        size = picture_size(path)
        if size != first:
            expected = f"{first[0]}x{first[1]} pixels as in {frames[0].name}"
            advice = "All frames of a recording must have one size: resize this one, or remove it."
            raise DataError(path, expected, f"{size[0]}x{size[1]}", advice)
    return first
