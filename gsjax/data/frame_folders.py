"""Folders of pictures that are the frames of a recording, in the order of their names."""

import re
import warnings
from pathlib import Path

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import picture_size

SUFFIXES = (".png", ".jpg", ".jpeg")

DEFAULT_RATE_HZ = 30.0
"""Frames a second, where the data do not say when they were taken."""

_NUMBER = re.compile(r"\d+")


def pictures(folder: Path) -> list[Path]:
    """The pictures in a folder, sorted by name; none where it is not there."""
    if not folder.is_dir():
        return []
    shown = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and not p.name.startswith("."))
    return sorted(path for path in shown if path.is_file())


def pictures_beside(folder: Path, count: int, frames: str) -> list[Path]:
    """As many pictures as there are frames: the masks or depth images of a recording, by order of name.

    Args:
        folder: of the pictures.
        count: how many frames there are.
        frames: what their folder or file is called, for messages.

    Raises:
        DataError: there are more or fewer.
    """
    found = pictures(folder)
    if len(found) != count:
        expected = f"{count} pictures, one a frame of {frames}"
        raise DataError(folder, expected, f"{len(found)}", "Was the folder copied whole? Pairs go by order.")
    return found


def frame_numbers(frames: list[Path]) -> tuple[int, ...]:
    """The last number in each name (frame-000012_color.png is 12); positions where a name has none, or where
    some would share one.

    Raises:
        DataError: names sort in another order than their numbers, so frames would be shuffled in time.
    """
    texts = [_NUMBER.findall(path.stem) for path in frames]
    if not all(texts):
        return tuple(range(len(frames)))
    numbers = [int(text[-1]) for text in texts]
    if len(set(numbers)) < len(numbers):
        return tuple(range(len(frames)))
    for before, after, number, following in zip(frames, frames[1:], numbers, numbers[1:], strict=False):
        if following < number:
            advice = "Pad the numbers with zeros to one length."
            found = f"{after.name} after {before.name}"
            raise DataError(frames[0].parent, "names that sort as their numbers do", found, advice)
    return tuple(numbers)


def warn_of_single_frame(frames: list[Path]) -> None:
    """Warns with DataWarning where there is only one."""
    if len(frames) == 1:
        message = f"{frames[0]}: it is the only frame, so nothing is seen to move; give more frames"
        warnings.warn(message, DataWarning, stacklevel=3)


def expect_one_size(frames: list[Path]) -> tuple[int, int]:
    """Width and height of all of them, from the heads of their files.

    Raises:
        DataError: one is no picture, or of another size than the first.
    """
    first = picture_size(frames[0])
    for path in frames[1:]:
        size = picture_size(path)
        if size != first:
            expected = f"{first[0]}x{first[1]} pixels as in {frames[0].name}"
            advice = "All frames of a recording share one size: bring this one to it, or take it out."
            raise DataError(path, expected, f"{size[0]}x{size[1]}", advice)
    return first
