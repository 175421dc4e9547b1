"""Pictures of the same held-out view in several runs, side by side, from the pictures that the runs wrote."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from gsjax.engine.pictures import PANELS
from gsjax.engine.records import Record
from gsjax.io.pictures import write_png
from gsjax.viz.colors import captioned

_COLUMNS = 4  # of a strip
_WIDTH = 1600  # pixels of a strip, at most
_TOLERANCE = 2.0  # of 255: photographs that differ more on average are of different views
_CHIP = (22, 24, 28)


class Panels(NamedTuple):
    """The pictures that a run wrote of a view, [H,W,3] each."""

    photograph: UInt8[np.ndarray, "h w 3"]
    rendered: UInt8[np.ndarray, "h w 3"]


def read_panels(record: Record, view: str) -> Panels | None:
    """The pictures of a held-out view; None if the run wrote none or they are gone."""
    rows = [] if record.metrics is None else record.metrics["views"]
    names = [row.get("picture") for row in rows if row["view"] == view]
    file = record.path / names[0] if names and names[0] else None
    picture = None if file is None else cv2.imread(str(file))
    if picture is None:
        return None
    width = picture.shape[1] // len(PANELS)  # one column may be left over: widths are even
    return Panels(*(picture[:, i * width : (i + 1) * width, ::-1] for i in range(2)))


def shows_the_same(records: list[Record], view: str) -> bool:
    """Whether all runs have the same photograph for a view; runs whose picture is gone are ignored."""
    photographs = [panels.photograph for panels in (read_panels(r, view) for r in records) if panels]
    return all(
        other.shape == photographs[0].shape and np.abs(other.astype(int) - photographs[0]).mean() < _TOLERANCE
        for other in photographs[1:]
    )


def write_strip(path: Path, records: Mapping[str, Record], view: str) -> bool:
    """Writes the photograph beside each run's render of it; returns whether there was anything to write.

    Args:
        path: the .png file.
        records: the runs by their labels, all of the same size.
        view: the name of the held-out view.
    """
    found = {label: read_panels(record, view) for label, record in records.items()}
    known = {label: panels for label, panels in found.items() if panels is not None}
    if not known:
        return False
    columns = -(-(1 + len(known)) // -(-(1 + len(known)) // _COLUMNS))  # fill rows evenly
    room = _WIDTH // columns
    pictures = [_relabelled(next(iter(known.values())).photograph, PANELS[0], PANELS[0], room)]
    for label, panels in known.items():
        text = label if (psnr := _psnr(records[label], view)) is None else f"{label}, {psnr:.1f} dB"
        pictures.append(_relabelled(panels.rendered, PANELS[1], text, room))
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % columns)
    rows = [np.concatenate(pictures[i : i + columns], axis=1) for i in range(0, len(pictures), columns)]
    write_png(path, np.concatenate(rows, axis=0))
    return True


def _psnr(record: Record, view: str) -> float | None:
    rows: list[dict[str, Any]] = [] if record.metrics is None else record.metrics["views"]
    return next((row["psnr"] for row in rows if row["view"] == view), None)


def _relabelled(
    picture: UInt8[np.ndarray, "h w 3"], old: str, new: str, room: int
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture with another caption in place of the one drawn on it, at most `room` pixels wide."""
    blank = np.full_like(picture, 255)
    painted = (captioned(blank, old) != blank).any(-1, keepdims=True)
    picture = np.where(painted, np.array(_CHIP, np.uint8), picture)
    height, width = picture.shape[:2]
    scale = min(1.0, room / width)
    size = (round(scale * width), max(1, round(scale * height)))
    return captioned(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), new)
