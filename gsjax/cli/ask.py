"""`gsjax ask`: questions about a deforming scene in plain English, answered from its measurements."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gsjax.engine.deform.file import read_deformation, warn_of_partial
from gsjax.engine.folder import DEFORMATION
from gsjax.engine.messages import Notes, stage
from gsjax.engine.options import Common
from gsjax.methods.deform import (
    QUESTIONS,
    DeformResult,
    Question,
    SceneFacts,
    TemplatedAnswerer,
    parse_question,
    rows_of,
    scene_facts,
)

HELP = (
    ' As in `gsjax ask RUN "how far is the tool from the tissue in frame 12?"`; without a question it lists '
    "what can be asked. The run needs features with a meaning: `gsjax deform DATASET --tools draw --out RUN`."
)


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax ask`."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run of `gsjax deform`."""
    question: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="[QUESTION]")] = None
    """The question, in plain English (default: list what can be asked)."""
    json: bool = False
    """Print JSON: the answer, its value and unit, and the facts that it rests on."""


def run(options: Options) -> int:
    """Answer a question, or list what can be asked; returns the exit code.

    Raises:
        ValueError, OSError: there is no such run, it has no meaning, or the question cannot be answered.
    """
    path = options.run / DEFORMATION
    result = read_deformation(path)
    if result.meaning is None:
        raise ValueError(
            f"{path}: expected a scene with named things, found none; reconstruct it with two classes "
            "or more among the pixels that count (gsjax deform DATASET --tools draw), or with --features"
        )
    if len(result.names) < 2:
        found = ", ".join(result.names)
        raise ValueError(f"{path}: expected two things or more to ask about, found {found} alone")
    console = Console(stderr=True, highlight=False)
    warn_of_partial(options.run, Notes(console))
    if options.question is None:
        _list(result)
        return 0
    asked = parse_question(options.question, result.names)
    rows = rows_of(asked, result.timeline.frame_ids.tolist())
    with stage(console, f"measuring {_in_words(result, rows)}"):
        # The depth of the first frame is the unit of lengths in a scene of unknown scale.
        facts = scene_facts(result, rows if result.timeline.metric or 0 in rows else [0, *rows])
    answer = TemplatedAnswerer()(options.question, facts)
    if options.json:
        found = {
            "question": options.question,
            "type": asked.kind,
            **answer._asdict(),
            "facts": _used(asked, facts),
        }
        print(json.dumps(found, indent=1))
    else:
        print(answer.text)
    return 0


def _used(asked: Question, facts: SceneFacts) -> dict[str, Any]:
    """The facts on which an answer is based."""
    steps = zip(range(len(facts.frames)), range(1, len(facts.frames)), strict=False)
    return {
        "unit": facts.unit,
        "gaussians": dict(zip(facts.names, facts.gaussians.tolist(), strict=True)),
        "frames": [facts.of_frame(row) for row in range(len(facts.frames))],
        "motion": [facts.of_motion(*pair) for pair in steps] if len(asked.frames) != 1 else [],
    }


def _in_words(result: DeformResult, rows: list[int]) -> str:
    """The frames that are measured, in words."""
    frames = [str(result.timeline.frame_ids[row]) for row in rows]
    if len(rows) == 1:
        return f"frame {frames[0]}"
    return "frames " + (f"{frames[0]} to {frames[-1]}" if len(rows) > 2 else " and ".join(frames))


def _list(result: DeformResult) -> None:
    """Prints what can be asked."""
    console = Console(highlight=False)
    frames = result.timeline.frame_ids
    console.print(Text.assemble("X and Y are of: ", (", ".join(result.names), "bold")), soft_wrap=True)
    console.print(f"F and G are frames: [bold]{frames.min()} to {frames.max()}[/]\n", soft_wrap=True)
    table = Table("type", "question", "answer", box=None, padding=(0, 3, 0, 0))
    for kind in QUESTIONS:
        gives = kind.gives if result.timeline.metric else kind.gives.replace(" mm", " % of the depth")
        table.add_row(f"[bold cyan]{kind.name}[/]", kind.example, gives)
    console.print(table)
