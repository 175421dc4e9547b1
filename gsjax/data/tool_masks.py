"""Masks of surgical tools: black-and-white ones, whose polarity the user states, and label maps, in which
tools are recognised by the names of their classes."""

import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int

from gsjax.data.errors import DataError, DataWarning

Tool = Literal["white", "black"]
"""Colour of the tool in a mask."""

TISSUE, TOOL = 0, 1
LABEL_NAMES = {TOOL: "tool"}
_FOLDERS = ("masks", "gt_masks")  # in EndoNeRF's releases
_CHECKED_FRAMES = 64
_TOOL_NAMES = re.compile(
    r"\b(tool|instrument|shaft|wrist|clasper|probe|forceps|driver|sealer|retractor|scissors|grasper|stapler|"
    r"needle|thread|clamp|clip|suction|hook|trocar|other)s?\b",
    re.IGNORECASE,
)


def find_masks(root: Path) -> Path | None:
    """The mask folder in a folder, or None."""
    return next((root / name for name in _FOLDERS if (root / name).is_dir()), None)


def is_tool(value: int, names: Mapping[int, str]) -> bool:
    """Whether a value of a label map denotes a tool: decided by its name, or, without a name, any value
    above 0 does.

    Args:
        value: the label of a pixel.
        names: names of labels, for example "suturing-needle" (a tool) or "kidney-parenchyma" (not a tool).
    """
    if value <= TISSUE:
        return False
    return value not in names or _TOOL_NAMES.search(re.sub(r"[-_]", " ", names[value])) is not None


def tool_labels(mask: Int[np.ndarray, "height width"], tool: str) -> Int[np.ndarray, "height width"]:
    """0 for tissue and 1 for a tool, int32.

    White means above 127, since JPEG compression leaves black not quite 0; or 1 in a mask of zeros and ones.

    Raises:
        ValueError: `tool` is neither "white" nor "black".
    """
    if tool not in ("white", "black"):
        raise ValueError(f"tool: expected 'white' or 'black', found {tool!r}")
    white = mask > (127 if mask.max() > 1 else 0)
    return np.where(white == (tool == "white"), TOOL, TISSUE).astype(np.int32)


def check_tool(load: Callable[[int], np.ndarray], frames: int, tool: Tool, where: object) -> None:
    """Check the labels of at most 64 evenly spaced frames for inverted masks, which would hide the tissue.

    Warns with DataWarning if the tool covers more than half of the picture in more than half of the frames.

    Args:
        load: frame -> labels, as `tool_labels` returns them.
        frames: number of frames.
        tool: colour of the tool in masks, "white" or "black".
        where: name of the masks in messages.

    Raises:
        DataError: the tool covers every checked picture completely.
    """
    chosen = np.unique(np.linspace(0, frames - 1, min(frames, _CHECKED_FRAMES)).astype(int))
    shares = np.array([np.mean(load(int(t)) == TOOL) for t in chosen])
    other = "black" if tool == "white" else "white"
    advice = f"Are they inverted? Then the tool is {other}: set tool (--read.tool {other})."
    if (shares == 1).all():
        found = f"only tool in all {len(shares)} checked frames"
        raise DataError(where, f"masks with a {tool} tool and some tissue", found, advice)
    many = np.sum(shares > 0.5)
    if 2 * many > len(shares):
        found = f"in {many} of {len(shares)} frames the tool covers more than half of the picture"
        warnings.warn(f"{where}: {found}. {advice}", DataWarning, stacklevel=3)
