"""Answers to questions on a deforming scene (SurstSplat, section 3.2; GaussianClin, section 4.3).

The papers give Med-LLaVA the scene's features and let GPT-4 judge its sentences. Here answers come from
facts, numbers measured in the scene: by default from templates of ten types of question, whose answers are
values that can be checked; or from a language model, by a custom function.
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
        value: of what was asked; None where it is not known, as of things that are not in view, or where
            only the sentence has it.
        unit: of the value, "" if it has none.
    """

    text: str
    value: str | bool | int | float | None
    unit: str = ""


class TemplatedAnswerer:
    """Answers the ten types of question of `QUESTIONS`, each with a value. Needs no model."""

    def __call__(self, question: str, facts: SceneFacts) -> Answer:
        """The answer.

        Raises:
            ValueError: as `parse_question`, or a frame is not among the facts.
        """
        asked = parse_question(question, facts.names)
        return _ANSWERS[asked.kind](asked, facts, rows_of(asked, facts.frames))


def _absent(asked: Question, facts: SceneFacts, row: int) -> str | None:
    """A sentence on the things in question that are not in view in the frame of a row; None if all are."""
    missing = [facts.names[k] for k in asked.things if not facts.present(row, k)]
    return f"There is no {' and no '.join(missing)} in frame {facts.frames[row]}." if missing else None


def _presence(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    there, name = facts.present(rows[0], asked.things[0]), facts.names[asked.things[0]]
    share = f", on {100 * facts.shares[rows[0], asked.things[0]]:.1f} % of the picture" if there else ""
    return Answer(f"{_yes(there)}, {name} is {'' if there else 'not '}in view{share}.", there)


def _count(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    count, name = int(facts.pieces[rows[0], asked.things[0]]), facts.names[asked.things[0]]
    return Answer(f"{count} piece{'' if count == 1 else 's'} of {name} in the picture.", count)


def _place(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    if (absent := _absent(asked, facts, rows[0])) is not None:
        return Answer(absent, None)
    where = part_of_picture(*facts.places[rows[0], asked.things[0]])
    return Answer(f"The centre of {facts.names[asked.things[0]]} is in the {where} of the picture.", where)


def part_of_picture(x: float, y: float) -> str:
    """The name of the ninth of a picture that a place is in; x from the left, y from the top, 0 to 1."""
    column, row = (min(2, int(3 * v)) for v in (x, y))
    name = f"{('upper', 'middle', 'lower')[row]} {('left', 'middle', 'right')[column]}"
    return "centre" if name == "middle middle" else name


def _depth(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    value = facts.depths[rows[0], asked.things[0]]
    if not np.isfinite(value):
        return Answer(_absent(asked, facts, rows[0]) or "Its depth is not known.", None, facts.unit)
    return Answer(
        f"{facts.names[asked.things[0]]} is {_length(value, facts)} deep.", float(value), facts.unit
    )


def _nearer(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    depths = facts.depths[rows[0], list(asked.things)]
    if not np.isfinite(depths).all():
        return Answer(_absent(asked, facts, rows[0]) or "Their depths are not known.", None)
    near, far = (facts.names[asked.things[i]] for i in np.argsort(depths, kind="stable"))
    words = " and ".join(_length(value, facts) for value in np.sort(depths))
    return Answer(f"{near} is nearer to the camera than {far}: {words}.", near)


def _distance(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    one, other = asked.things
    value = facts.gaps[rows[0], one, other]
    if not np.isfinite(value):
        return Answer(_absent(asked, facts, rows[0]) or "Their distance is not known.", None, facts.unit)
    words = f"{facts.names[one]} and {facts.names[other]} are {_length(value, facts)} apart"
    return Answer(f"{words} where they are nearest.", float(value), facts.unit)


def _touch(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    one, other = asked.things
    value = facts.gaps[rows[0], one, other]
    touch = bool(value < TOUCH)
    if not np.isfinite(value):
        words = _absent(asked, facts, rows[0]) or "their distance is not known."
        return Answer(f"No: {words}", False)
    return Answer(f"{_yes(touch)}, they are {_length(value, facts)} apart where they are nearest.", touch)


def _motion(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    value = facts.moved[rows[0], rows[1], asked.things[0]]
    if not np.isfinite(value):
        return Answer(_absent(asked, facts, rows[0]) or "Its way is not known.", None, facts.unit)
    still = ", as good as not at all" if value < STILL else ""
    words = f"What frame {facts.frames[rows[0]]} shows of {facts.names[asked.things[0]]} moves by "
    return Answer(f"{words}{_length(value, facts)} in the median{still}.", float(value), facts.unit)


def _direction(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    shift = facts.shifts[rows[0], rows[1], asked.things[0]]
    if not np.isfinite(shift).all():
        return Answer(_absent(asked, facts, rows[0]) or "Its way is not known.", None)
    where, length = main_direction(shift), float(np.linalg.norm(shift))
    name, words = (
        facts.names[asked.things[0]],
        {"towards": "towards the camera", "away": "away from the camera"},
    )
    if where == "still":
        return Answer(f"{name} stands still: it moves by {_length(length, facts)} in the mean.", where)
    return Answer(
        f"{name} moves by {_length(length, facts)} in the mean, mostly {words.get(where, where)}.", where
    )


def main_direction(shift: Float[np.ndarray, "3"]) -> str:
    """The word for a displacement (right, down, forward in axes of the camera, in the facts' unit)."""
    if np.linalg.norm(shift) < STILL:
        return "still"
    axis = int(np.abs(shift).argmax())
    return (("left", "right"), ("up", "down"), ("towards", "away"))[axis][int(shift[axis] > 0)]


def _when(asked: Question, facts: SceneFacts, rows: list[int]) -> Answer:
    things = list(asked.things)
    words = " and ".join(facts.names[k] for k in things)
    if asked.event == "first seen":
        score, verb = np.where(facts.pieces[:, things[0]] > 0, 1.0, np.nan), "are first seen"
    elif asked.event == "touch":
        gaps = facts.gaps[:, things[0], things[1]]
        score, verb = np.where(gaps < TOUCH, 1.0, np.nan), "first touch"
    elif asked.event == "nearest":
        score, verb = -facts.depths[:, things[0]], "are nearest to the camera"
    else:
        score, verb = speeds(facts, things[0]), "are fastest"
    if not np.isfinite(score).any():
        never = f"Never: in none of the {len(rows)} frames."
        if asked.event == "touch" and np.isfinite(gaps).any():
            nearest = facts.frames[int(np.nanargmin(gaps))]
            never += f" They are nearest in frame {nearest}, {np.nanmin(gaps):.1f} {facts.unit} apart."
        return Answer(never, None)
    frame = facts.frames[int(np.nanargmax(score))]
    return Answer(
        f"{words} {verb if len(things) == 2 else verb.replace('are', 'is')} in frame {frame}.", frame
    )


def speeds(facts: SceneFacts, thing: int) -> Float[np.ndarray, "T"]:
    """How fast what a frame shows of a class goes to the next one, over the recording's time, for each frame
    but the last, which has NaN."""
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
    """A language model answers, from the same facts; it gives a sentence, and no value that could be checked.

    Attributes:
        complete: the model; whatever takes a prompt and returns a text.
    """

    complete: LanguageModel

    def __call__(self, question: str, facts: SceneFacts) -> Answer:
        """The answer."""
        return Answer(self.complete(question_prompt(question, facts)).strip(), None)


def question_prompt(question: str, facts: SceneFacts) -> str:
    """The prompt for a language model: the facts in words, and the question."""
    lines = [
        "A scene seen by an endoscope was reconstructed and measured. Answer the question from these facts "
        "alone, in one sentence; if they do not say it, say so.",
        f"Lengths are in {facts.unit}. Extents and displacements are right, down, forward as the camera of "
        "the frame sees them. Places in the picture are from its left and top, 0 to 1.",
        f"Things: {', '.join(facts.names)}. Frames: {', '.join(map(str, facts.frames))}.",
    ]
    for row, number in enumerate(facts.frames):
        lines.append(f"Frame {number}:")
        lines += [f"- {_in_words(facts, row, k)}" for k in range(len(facts.names))]
    return "\n".join([*lines, "", f"Question: {question.strip()}", "Answer:"])


def _in_words(facts: SceneFacts, row: int, thing: int) -> str:
    """The facts of a class in a frame, in words."""
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
        way = facts.shifts[row, row + 1, thing]
        words.append(f"moves by {_three(way)} until frame {facts.frames[row + 1]}")
    return ", ".join(words)


def _three(values: Float[np.ndarray, "3"]) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in values) + ")"
