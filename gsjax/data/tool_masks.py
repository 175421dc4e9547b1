"""Masks of surgical tools: in black and white, where which of the two is the tool is for the user to say; and
in label maps, by what classes are called."""

import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int

from gsjax.data.errors import DataError, DataWarning

Tool = Literal["white", "black"]
"""What the tool is in a mask."""

TISSUE, TOOL = 0, 1
LABEL_NAMES = {TOOL: "tool"}
_FOLDERS = ("masks", "gt_masks")  # in EndoNeRF's releases
_FRAMES_LOOKED_AT = 64
_CALLED = re.compile(
    r"\b(tool|instrument|shaft|wrist|clasper|probe|forceps|driver|sealer|retractor|scissors|grasper|stapler|"
    r"needle|thread|clamp|clip|suction|hook|trocar|other)s?\b",
    re.IGNORECASE,
)


def find_masks(root: Path) -> Path | None:
    """The folder of masks in a folder, or None."""
    return next((root / name for name in _FOLDERS if (root / name).is_dir()), None)


def is_tool(value: int, names: Mapping[int, str]) -> bool:
    """Whether a value of a label map is of a tool: all but 0, where it has no name; else by its name.

    Args:
        value: of a pixel.
        names: of values, "suturing-needle" say, a tool, or "kidney-parenchyma", none.
    """
    if value <= TISSUE:
        return False
    return value not in names or _CALLED.search(re.sub(r"[-_]", " ", names[value])) is not None


def tool_labels(mask: Int[np.ndarray, "height width"], tool: str) -> Int[np.ndarray, "height width"]:
    """0 where there is tissue and 1 where there is a tool, int32.

    White is more than 127, for what was saved as JPEG is not quite black; or 1 in a mask of zeros and ones.

    Raises:
        ValueError: `tool` is neither.
    """
    if tool not in ("white", "black"):
        raise ValueError(f"tool: expected 'white' or 'black', found {tool!r}")
    white = mask > (127 if mask.max() > 1 else 0)
    return np.where(white == (tool == "white"), TOOL, TISSUE).astype(np.int32)


def check_tool(load: Callable[[int], np.ndarray], frames: int, tool: Tool, where: object) -> None:
    """A look at labels, of at most 64 frames that are spread evenly: an inverted mask hides the tissue.

    Warns with DataWarning where the tool covers more than half of the picture in more than half of them.

    Args:
        load: frame to labels, as `tool_labels` gives them.
        frames: how many there are.
        tool: what it is in masks, "white" or "black".
        where: what messages name.

    Raises:
        DataError: it covers all of every picture.
    """
    chosen = np.unique(np.linspace(0, frames - 1, min(frames, _FRAMES_LOOKED_AT)).astype(int))
    shares = np.array([np.mean(load(int(t)) == TOOL) for t in chosen])
    other = "black" if tool == "white" else "white"
    advice = f"Are they inverted? Then the tool is {other}: set tool (--read.tool {other})."
    if (shares == 1).all():
        found = f"nothing but tool in all {len(shares)} frames looked at"
        raise DataError(where, f"masks with the tool {tool} and some tissue", found, advice)
    many = np.sum(shares > 0.5)
    if 2 * many > len(shares):
        found = f"in {many} of {len(shares)} frames the tool covers more than half of the picture"
        warnings.warn(f"{where}: {found}. {advice}", DataWarning, stacklevel=3)
