"""Questions about a deforming scene in plain English: ten types, parsed by templates."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

TOUCH = 2.0
"""Distance below which two things touch, in the unit of the facts: mm, or per cent of the depth."""
STILL = 1.0
"""Displacement below which a thing stands still, in the unit of the facts."""


class QuestionType(NamedTuple):
    """A type of question.

    Attributes:
        name: name of the type.
        example: an example, with X and Y for things, F and G for frames.
        gives: the kind of value, and its unit.
        frames: number of frames that the question names.
        forms: regular expressions that match the question once frames and articles are removed; groups x and
            y are things.
    """

    name: str
    example: str
    gives: str
    frames: int
    forms: tuple[str, ...]


_X, _Y, _CAMERA = r"(?P<x>.+?)", r"(?P<y>.+?)", r"(?:to |from )?(?:camera|endoscope|scope|lens|viewer)"
QUESTIONS = (
    QuestionType(
        "presence",
        "is there X in frame F?",
        "yes or no",
        1,
        (
            rf"(?:is|are) there {_X}",
            rf"(?:is|are) {_X} (?:there|visible|present|in view|seen)",
            rf"can you see {_X}",
        ),
    ),
    QuestionType(
        "count",
        "how many X are there in frame F?",
        "pieces in the picture",
        1,
        (rf"how many {_X}(?: (?:are|is) (?:there|visible|in view))?", rf"what is number of {_X}"),
    ),
    QuestionType(
        "place",
        "where is X in frame F?",
        "of nine parts of the picture: upper left, upper middle, ..., centre, ..., lower right",
        1,
        (rf"where (?:is|are) {_X}", rf"in which part of picture (?:is|are) {_X}"),
    ),
    QuestionType(
        "depth",
        "how deep is X in frame F?",
        "median along the camera's axis, mm",
        1,
        (
            rf"how deep (?:is|are) {_X}",
            rf"how far(?: away)? (?:is|are) {_X}(?: away)? {_CAMERA}",
            rf"how far away (?:is|are) {_X}",
            rf"what is depth of {_X}",
        ),
    ),
    QuestionType(
        "nearer",
        "which is nearer to the camera in frame F, X or Y?",
        "X or Y, by their depths",
        1,
        (
            rf"(?:which|what) is (?:nearer|closer)(?: {_CAMERA})? {_X} or {_Y}",
            rf"is {_X} or {_Y} (?:nearer|closer)(?: {_CAMERA})?",
        ),
    ),
    QuestionType(
        "distance",
        "how far is X from Y in frame F?",
        "where they are nearest, mm",
        1,
        (
            rf"how far (?:is|are) {_X} from {_Y}",
            rf"how far apart are {_X} and {_Y}",
            rf"what is distance (?:between|from|of) {_X} (?:and|to|from) {_Y}",
        ),
    ),
    QuestionType(
        "touch",
        "do X and Y touch in frame F?",
        f"yes or no: nearer than {TOUCH:g} mm",
        1,
        (
            rf"(?:do|does) {_X} and {_Y} touch(?: each other)?",
            rf"(?:do|does) {_X} touch {_Y}",
            rf"is {_X} (?:touching|in contact with) {_Y}",
            rf"are {_X} and {_Y} (?:touching|in contact)",
        ),
    ),
    QuestionType(
        "motion",
        "how far does X move between frames F and G?",
        "median of what frame F shows of it, mm",
        2,
        (rf"how (?:far|much) (?:do|does|did) {_X} move", rf"(?:do|does|did) {_X} move"),
    ),
    QuestionType(
        "direction",
        "in which direction does X move between frames F and G?",
        f"left, right, up, down, towards or away from the camera of frame F, or still: below {STILL:g} mm",
        2,
        (
            rf"(?:in )?(?:which|what) (?:direction|way) (?:do|does|did) {_X} move",
            rf"where (?:do|does|did) {_X} move",
        ),
    ),
    QuestionType(
        "when",
        "when is X first seen? (or: fastest, nearest to the camera; when do X and Y first touch?)",
        "a frame",
        0,
        (
            rf"when (?:is|are) {_X} (?P<event>first seen|fastest|nearest|closest)(?: {_CAMERA})?",
            rf"when (?:do|does) {_X} (?:first )?(?P<event>appear)",
            rf"when (?:do|does) {_X} move (?P<event>fastest)",
            rf"when (?:do|does) {_X} and {_Y} (?:first )?(?P<event>touch)",
            rf"when (?:do|does) {_X} (?:first )?(?P<event>touch) {_Y}",
        ),
    ),
)
"""The ten types."""
_ARTICLES = re.compile(r"\b(?:the|a|an|any)\b")
_FRAMES = re.compile(
    r"(?:\b(?:in|at|on|from|between|and|to|until)\s+)?\bframes?\s+(\d+)(?:\s+(?:and|to|until)\s+(\d+)\b)?"
)
_SYNONYMS = {"appear": "first seen", "closest": "nearest"}  # of events


@dataclass(frozen=True)
class Question:
    """A parsed question.

    Attributes:
        kind: name of its type.
        things: rows of the classes in question.
        frames: numbers, in the recording, of the frames in question.
        event: the event of a `when` question.
    """

    kind: str
    things: tuple[int, ...]
    frames: tuple[int, ...]
    event: str = ""


def parse_question(text: str, names: Sequence[str]) -> Question:
    """Parse a question.

    Args:
        text: the question; case, articles, plurals and the position of the frames do not matter.
        names: names of the classes.

    Raises:
        ValueError: no template matches, or the question names an unknown thing, the same one twice, or the
            wrong number of frames.
    """
    plain = " ".join(re.sub(r"[?!.,;:\"]", " ", text.lower()).split())
    frames = tuple(int(number) for found in _FRAMES.findall(plain) for number in found if number)
    core = plain_words(_FRAMES.sub(" ", plain))
    unknown = None
    for kind in QUESTIONS:
        for form in kind.forms:
            found = re.fullmatch(form, core)
            if found is None:
                continue
            parts = found.groupdict()
            spoken = [parts[name] for name in ("x", "y") if parts.get(name)]
            things = [_thing(words, names) for words in spoken]
            if None in things:
                unknown = unknown or spoken[things.index(None)]
                continue
            _check(kind, text, things, frames)
            event = parts.get("event", "")
            return Question(kind.name, tuple(things), frames, _SYNONYMS.get(event, event))
    known = ", ".join(names)
    if unknown is not None:
        raise ValueError(f"{text!r}: expected things of this scene, found {unknown!r}; there are: {known}")
    raise ValueError(
        f"{text!r}: expected one of these questions, where F and G are frames, X and Y among {known}: "
        + " ".join(kind.example for kind in QUESTIONS)
    )


def plain_words(text: str) -> str:
    """Lower-case words without articles, separated by spaces: "The suturing-needle" is a suturing needle."""
    return " ".join(_ARTICLES.sub(" ", " ".join(re.findall(r"[^\W_]+", text.lower()))).split())


def _thing(words: str, names: Sequence[str]) -> int | None:
    """The row of the class of this name, else of its singular or plural; None if there is none."""
    known = [plain_words(name) for name in names]
    if words in known:  # "clip" and "clips" may both be names
        return known.index(words)
    rows = (row for row, name in enumerate(known) if words in _plurals(name) or name in _plurals(words))
    return next(rows, None)


def _plurals(word: str) -> set[str]:
    return {f"{word}s", f"{word}es", re.sub("y$", "ies", word)}


def _check(kind: QuestionType, text: str, things: Sequence[int | None], frames: tuple[int, ...]) -> None:
    if len(things) == 2 and things[0] == things[1]:
        raise ValueError(f"{text!r}: expected two things, found the same one twice")
    if len(frames) != kind.frames:
        count = ("no frame", "a frame", "two frames")[kind.frames]
        raise ValueError(f"{text!r}: expected {count}, found {len(frames) or 'none'}; as in: {kind.example}")


def rows_of(question: Question, frames: Sequence[int]) -> list[int]:
    """Rows of the frames in question: those it names, else all.

    Raises:
        ValueError: the recording lacks one of them.
    """
    places = {int(number): row for row, number in enumerate(frames)}
    for number in question.frames:
        if number not in places:
            raise ValueError(
                f"frame {number}: expected one of the recording's {len(places)} frames, numbered "
                f"{min(places)} to {max(places)}, found none with this number"
            )
    return [places[number] for number in question.frames] or list(range(len(frames)))
