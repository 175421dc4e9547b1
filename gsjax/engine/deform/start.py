"""The start of `gsjax.deform`: that of `gsjax deform`, but with all frames, and each kind of warning once."""

import warnings
from dataclasses import replace

from rich.console import Console

from gsjax.data.errors import DataWarning
from gsjax.data.sequence import Sequence
from gsjax.engine.deform.data import Tools, deform_data
from gsjax.engine.deform.depth import METRIC, with_depth
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.methods.deform import Deform, Problem
from gsjax.optim.method import Run
from gsjax.scene.gaussians import Gaussians


def start_from(
    method: Deform,
    sequence: Sequence,
    teacher: TeacherChoice | str | None,
    tools: Tools,
    tool_values: tuple[int, ...],
    first: int | None,
    gaussians: Gaussians | None,
) -> tuple[Problem, Run]:
    """The problem and the run before its first step; oddities of the data become warnings.

    Args:
        method: with its settings.
        sequence, teacher, tools, tool_values, first, gaussians: as for `gsjax.deform`.

    Raises:
        ValueError, DataError, FileNotFoundError: as for `gsjax.deform`.
    """
    choice = teacher if isinstance(teacher, TeacherChoice) else TeacherChoice(teacher or "auto")
    choice.check(optional=True)
    quiet, config = Console(quiet=True), method.config
    notes = Notes(quiet)
    every = replace(sequence, splits=None)  # what is learned from is selected by whoever calls
    with notes:
        seen, source = with_depth(every, "auto", config.plane_depth, notes)
        data = deform_data(seen, 0, tools, choice, config.channels, tool_values, notes, quiet)
    if first is not None and first not in data.train:
        raise ValueError(f"first: expected one of the training frames, {data.train}, found {first}")
    for text in notes.warnings:
        warnings.warn(text, DataWarning, stacklevel=3)
    if first is not None:
        first = data.train.index(first)
    elif source != "hull":
        first = data.first
    return method.start(
        data.frames,
        data.lesson,
        first=first,
        gaussians=gaussians,
        timeline=data.timeline(metric=source in METRIC),
        background=seen.background,
        hull=source == "hull",
    )
