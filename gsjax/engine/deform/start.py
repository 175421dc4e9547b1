"""The start of the function `gsjax.deform`: as in the command `gsjax deform`, but with all frames, and with
Python warnings instead of notes."""

import warnings
from dataclasses import replace

from rich.console import Console

from gsjax.data.errors import DataWarning
from gsjax.data.sequence import Sequence
from gsjax.engine.deform.data import Tools, deform_data
from gsjax.engine.deform.depth import METRIC, shows_one_object, with_depth
from gsjax.engine.messages import Notes
from gsjax.engine.teaching.choice import TeacherChoice
from gsjax.losses.extra import ExtraLosses
from gsjax.methods.deform import PRESETS, Deform, DeformConfig, Problem
from gsjax.optim.method import Run
from gsjax.scene.gaussians import Gaussians


def start_from(
    config: DeformConfig | None,
    extra_losses: ExtraLosses,
    sequence: Sequence,
    teacher: TeacherChoice | str | None,
    tools: Tools,
    tool_values: tuple[int, ...],
    first: int | None,
    gaussians: Gaussians | None,
) -> tuple[Deform, Problem, Run]:
    """The method, its problem, and the run before its first step. Warns once of each kind of oddity in the
    data.

    Args:
        config, extra_losses, sequence, teacher, tools, tool_values, first, gaussians: as for `gsjax.deform`.

    Raises:
        ValueError, DataError, FileNotFoundError: as for `gsjax.deform`.
    """
    choice = teacher if isinstance(teacher, TeacherChoice) else TeacherChoice(teacher or "auto")
    choice.check(optional=True)
    quiet = Console(quiet=True)
    notes = Notes(quiet, of_all=True)
    every = replace(sequence, splits=None)  # the caller selects the training frames
    try:
        with notes:
            plane = (config or DeformConfig()).plane_depth
            seen, source = with_depth(every, "auto", plane, notes)
            if config is None:
                config = PRESETS["around"] if shows_one_object(seen, source) else DeformConfig()
            data = deform_data(seen, 0, tools, choice, config.channels, tool_values, notes, quiet)
    finally:
        for text in notes.warnings:
            warnings.warn(text, DataWarning, stacklevel=3)
    if first is not None and first not in data.train:
        raise ValueError(f"first: expected one of the training frames, {data.train}, found {first}")
    if first is not None:
        first = data.train.index(first)
    elif source != "hull":
        first = data.first
    method = Deform(config, extra_losses)
    problem, run = method.start(
        data.frames,
        data.lesson,
        first=first,
        gaussians=gaussians,
        timeline=data.timeline(metric=source in METRIC),
        background=seen.background,
        hull=source == "hull",
    )
    return method, problem, run
