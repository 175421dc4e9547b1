"""The curve of a fit as TensorBoard event files, in addition to metrics.jsonl; an optional extra."""

import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

from gsjax import extras

TAGS = {"loss": "loss", "psnr": "psnr", "test_psnr": "psnr_held_out", "alive": "gaussians"}
"""Tags of the values of a row."""
_FLUSHED_EVERY_S = 1


class TensorBoard:
    """Writes event files into RUN/tensorboard, one row of a fit's curve at a time.

    Each row is on disk a second after `add`. If a run was killed, there may be rows from after the checkpoint
    from which it resumes: they are purged, so that none is shown twice.

    Args:
        folder: of the run.
        rows: the rows of a resumed run; if there are none, the files of an earlier run are removed.

    Raises:
        MissingExtra: tensorboardX is not installed.
    """

    def __init__(self, folder: Path, rows: Sequence[Mapping[str, Any]] = ()):
        writer = extras.load("tensorboardX", "tensorboard", "--tensorboard").SummaryWriter
        path = folder / "tensorboard"
        going_on = len(rows) > 0 and any(path.glob("events.*"))
        if path.exists() and not going_on:
            shutil.rmtree(path)
        begun = rows[-1]["step"] + 1 if going_on else None
        # Files are named by their time in seconds, and read in the order of their names.
        self._writer = writer(
            str(path), purge_step=begun, filename_suffix=f".{begun or 0:08d}", flush_secs=_FLUSHED_EVERY_S
        )
        self._step = 0
        for row in rows:
            self._step = row["step"]
            if not going_on:  # so far the run had no event files
                self.add(row)

    def add(self, row: Mapping[str, Any]) -> None:
        """Write a row: its loss, PSNR, PSNR of held-out views, and number of Gaussians."""
        self._step = row["step"]
        for key, tag in TAGS.items():
            if row[key] is not None and math.isfinite(row[key]):
                self._writer.add_scalar(tag, row[key], self._step)

    def close(self, pictures: Mapping[str, Path] | None = None) -> None:
        """Close the file, after adding named pictures at the last step; a missing picture is left out."""
        for name, path in (pictures or {}).items():
            picture = cv2.imread(str(path))
            if picture is not None:
                self._writer.add_image(name, picture[..., ::-1], self._step, dataformats="HWC")
        self._writer.close()
