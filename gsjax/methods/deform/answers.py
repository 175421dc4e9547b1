"""Answers to questions about a deforming scene (SurstSplat, section 3.2; GaussianClin, section 4.3).

The papers give the scene's features to Med-LLaVA and have GPT-4 judge its sentences. Here the answers rest on
facts, numbers measured in the scene: by default from templates for ten types of question, whose values can be
checked, or from a language model through a custom function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.methods.deform.facts import SceneFacts
from gsjax.methods.deform.questions import STILL, TOUCH, Question, parse_question, rows_of
from gsjax.methods.protocols import LanguageModel


class Answer(NamedTuple):
    """The answer to a question.

    Attributes:
        text: a sentence.
        value: the value; None if it is unknown (for example, if a class is not in view) or given only in the
            sentence.
        unit: unit of the value, "" if it has none.
    """

    text: str
    value: str | bool | int | float | None
    unit: str = ""


class TemplatedAnswerer:
    """Answers the ten types of question of `QUESTIONS`, each with a value. Needs no model."""

    def __call__(self, question: str, facts: SceneFacts) -> Answer:
        """The answer.

        Raises:
            ValueError: as for `parse_question`, or a frame is not among the facts.
        """
        asked = parse_question(question, facts.names)
        return _ANSWERS[asked.kind](asked, facts, rows_of(asked, facts.frames))


def _absent(asked: Question, facts: SceneFacts, row: int) -> str | None:
    """A sentence that names the things asked about that are not visible in a frame; None if all are."""
    missing = [facts.names[k] for k in asked.things if not facts.present(row, k)]
    return f"There is no {' and no '.join(missing)} in frame {facts.frames[row]}." if missing else None


def _unknown(asked: Question, facts: SceneFacts, row: int, what: str, unit: str = "") -> Answer:
    """The answer without a value."""
    return Answer(_absent(asked, facts, row) or f"{what} is not known.", None, unit)


def _presence(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    (thing,), row = asked.things, rows[0]
    there = facts.present(row, thing)
    share = f", on {100 * facts.shares[row, thing]:.1f} % of the picture" if there else ""
    return Answer(f"{_yes(there)}, {facts.names[thing]} is {'' if there else 'not '}in view{share}.", there)


def _count(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    count, name = int(facts.pieces[rows[0], asked.things[0]]), facts.names[asked.things[0]]
    return Answer(f"{count} piece{'' if count == 1 else 's'} of {name} in the picture.", count)


def _place(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    if (absent := _absent(asked, facts, rows[0])) is not None:
        return Answer(absent, None)
    where = part_of_picture(*facts.places[rows[0], asked.things[0]])
    return Answer(f"The centre of {facts.names[asked.things[0]]} is in the {where} of the picture.", where)


def part_of_picture(x: float, y: float) -> str:
    """The name of the cell of a 3x3 grid over the image that contains a place; x from the left, y from the
    top, 0 to 1."""
    column, row = (min(2, int(3 * v)) for v in (x, y))
    name = f"{('upper', 'middle', 'lower')[row]} {('left', 'middle', 'right')[column]}"
    return "centre" if name == "middle middle" else name


def _depth(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    value, name = facts.depths[rows[0], asked.things[0]], facts.names[asked.things[0]]
    if not np.isfinite(value):
        return _unknown(asked, facts, rows[0], "Its depth", facts.unit)
    return Answer(f"{name} is {_length(value, facts)} deep.", float(value), facts.unit)


def _nearer(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    depths = facts.depths[rows[0], list(asked.things)]
    if not np.isfinite(depths).all():
        return _unknown(asked, facts, rows[0], "One of their depths")
    near, far = (facts.names[asked.things[i]] for i in np.argsort(depths, kind="stable"))
    words = " and ".join(_length(value, facts) for value in np.sort(depths))
    return Answer(f"{near} is nearer to the camera than {far}: {words}.", near)


def _distance(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    one, other = asked.things
    value = facts.gaps[rows[0], one, other]
    if not np.isfinite(value):
        return _unknown(asked, facts, rows[0], "Their distance", facts.unit)
    words = f"{facts.names[one]} and {facts.names[other]} are {_length(value, facts)} apart"
    return Answer(f"{words} where they are nearest.", float(value), facts.unit)


def _touch(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    value = facts.gaps[rows[0], asked.things[0], asked.things[1]]
    if (absent := _absent(asked, facts, rows[0])) is not None:
        return Answer(f"No: {absent}", False)
    if not np.isfinite(value):
        return _unknown(asked, facts, rows[0], "Their distance")
    touch = bool(value < TOUCH)
    return Answer(f"{_yes(touch)}, they are {_length(value, facts)} apart where they are nearest.", touch)


def _motion(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    value, name = facts.moved[rows[0], rows[1], asked.things[0]], facts.names[asked.things[0]]
    if not np.isfinite(value):
        return _unknown(asked, facts, rows[0], "Its motion", facts.unit)
    still = ", which is next to nothing" if value < STILL else ""
    words = f"The part of {name} that frame {facts.frames[rows[0]]} shows moves by {_length(value, facts)}"
    return Answer(f"{words} in the median{still}.", float(value), facts.unit)


def _direction(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    shift, name = facts.shifts[rows[0], rows[1], asked.things[0]], facts.names[asked.things[0]]
    if not np.isfinite(shift).all():
        return _unknown(asked, facts, rows[0], "Its motion")
    where, length = main_direction(shift), _length(float(np.linalg.norm(shift)), facts)
    if where == "still":
        return Answer(f"{name} stands still: it moves by {length} on average.", where)
    words = {"towards": "towards the camera", "away": "away from the camera"}.get(where, where)
    return Answer(f"{name} moves by {length} on average, mostly {words}.", where)


def main_direction(shift: Float[np.ndarray, "3"]) -> str:
    """The word for a displacement (right, down, forward in the camera's axes, in the facts' unit)."""
    if np.linalg.norm(shift) < STILL:
        return "still"
    axis = int(np.abs(shift).argmax())
    return (("left", "right"), ("up", "down"), ("towards", "away"))[axis][int(shift[axis] > 0)]


def _when(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    first, gaps = asked.things[0], facts.gaps[:, asked.things[0], asked.things[-1]]
    if asked.event == "first seen":
        score, verb = np.where(facts.pieces[:, first] > 0, 1.0, np.nan), "is first seen"
    elif asked.event == "touch":
        score, verb = np.where(gaps < TOUCH, 1.0, np.nan), "first touch"
    elif asked.event == "nearest":
        score, verb = -facts.depths[:, first], "is nearest to the camera"
    else:
        score, verb = _speeds(facts, first), "is fastest"
    if not np.isfinite(score).any():
        never = f"Never: in none of the {len(rows)} frames."
        if asked.event == "touch" and np.isfinite(gaps).any():
            nearest = facts.frames[int(np.nanargmin(gaps))]
            never += f" They are nearest in frame {nearest}, {np.nanmin(gaps):.1f} {facts.unit} apart."
        elif any(_absent(asked, facts, row) is None for row in rows):
            return Answer("It is not known.", None)
        return Answer(never, None)
    frame = facts.frames[int(np.nanargmax(score))]
    names = " and ".join(facts.names[k] for k in asked.things)
    return Answer(f"{names} {verb} in frame {frame}.", frame)


def _speeds(facts: SceneFacts, thing: int) -> Float[np.ndarray, "T"]:
    """Speed of a class's visible points from each frame to the next, per unit of time; NaN for the last."""
    steps = np.diagonal(facts.moved[:, :, thing], offset=1)
    return np.append(steps / np.maximum(np.diff(facts.times), 1e-9), np.nan)


def _yes(value: bool) -> str:
    return "Yes" if value else "No"


def _length(value: float, facts: SceneFacts) -> str:
    return f"{value:.1f} {facts.unit}"


_ANSWERS: dict[str, Callable[[Question, SceneFacts, list[int]], Answer]] = {
    "presence": _presence,
    "count": _count,
    "place": _place,
    "depth": _depth,
    "nearer": _nearer,
    "distance": _distance,
    "touch": _touch,
    "motion": _motion,
    "direction": _direction,
    "when": _when,
}


@dataclass(frozen=True)
class PromptedAnswerer:
    """Answers by a language model from the same facts: a sentence without a value.

    Attributes:
        complete: the model, a function from a prompt to a text.
    """

    complete: LanguageModel

    def __call__(self, question: str, facts: SceneFacts) -> Answer:
        """The answer."""
        return Answer(self.complete(question_prompt(question, facts)).strip(), None)


def question_prompt(question: str, facts: SceneFacts) -> str:
    """The prompt for a language model: the facts in words, and the question."""
    lines = [
        "A scene seen by an endoscope was reconstructed and measured. Answer the question from these facts "
        "alone, in one sentence; if they do not contain the answer, say so.",
        f"Lengths are in {facts.unit}. Extents and displacements are right, down, forward as the camera of "
        "the frame sees them. Places in the picture are from its left and top, 0 to 1.",
        f"Things: {', '.join(facts.names)}. Frames: {', '.join(map(str, facts.frames))}.",
    ]
    for row, number in enumerate(facts.frames):
        lines.append(f"Frame {number}:")
        lines += [f"- {_in_words(facts, row, k)}" for k in range(len(facts.names))]
    return "\n".join([*lines, "", f"Question: {question.strip()}", "Answer:"])


def _in_words(facts: SceneFacts, row: int, thing: int) -> str:
    """The facts of a class in one frame, for a prompt."""
    if not facts.present(row, thing):
        return f"{facts.names[thing]}: not in view"
    x, y = facts.places[row, thing]
    words = [
        f"{facts.names[thing]}: {100 * facts.shares[row, thing]:.1f} % of the picture",
        f"in {facts.pieces[row, thing]} piece(s)",
        f"centre at {x:.2f}, {y:.2f}",
        f"depth {facts.depths[row, thing]:.1f}",
        f"extent {_three(facts.extents[row, thing])}",
    ]
    for other, name in enumerate(facts.names):
        if other != thing and np.isfinite(facts.gaps[row, thing, other]):
            words.append(f"{facts.gaps[row, thing, other]:.1f} from {name}")
    if row + 1 < len(facts.frames):
        shift = facts.shifts[row, row + 1, thing]
        words.append(f"moves by {_three(shift)} until frame {facts.frames[row + 1]}")
    return ", ".join(words)


def _three(values: Float[np.ndarray, "3"]) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in values) + ")"
