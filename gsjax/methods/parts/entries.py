"""Entries of a script: frozen dataclasses whose fields' metadata say how values are checked.

`metadata["check"]` returns a value as it is kept, or raises a ValueError with what was expected and what
was found. `metadata["wanted"]` says what that is, `metadata["key"]` is the field's name in scripts where that
is another one, and `metadata["example"]` a value to begin with where there is no default.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import MISSING, Field, dataclass, fields
from difflib import get_close_matches
from typing import Any, TypeVar

ALL = "all"
"""In place of parts: every one, the background included."""
Vector = tuple[float, ...]
Checked = dict[str, Any]
"""Metadata of a field."""
_LONG = 200  # letters of what was found, in a message
_FAR = 1e6  # more metres, degrees or seconds than anybody means


@dataclass(frozen=True, kw_only=True)
class Entry:
    """What is checked field by field when it is made; a field whose default is None may be None.

    Raises:
        ValueError: a value is not as expected; the message begins with its key.
    """

    def __post_init__(self):
        for f in fields(self):
            object.__setattr__(self, f.name, _checked(f, getattr(self, f.name)))


Kind = TypeVar("Kind", bound=Entry)


def key_of(f: Field) -> str:
    """A field's name in scripts."""
    return f.metadata.get("key", f.name)


def read(kind: type[Kind], found: Any) -> Kind:
    """The entry that a mapping describes.

    Raises:
        ValueError: it is no mapping, a key is unknown or missing, or a value is not as expected.
    """
    keys = {key_of(f): f for f in fields(kind)}
    if not isinstance(found, dict):
        raise ValueError(f"expected the keys {', '.join(keys)}, found {shown(found)}")
    for key in found:
        if key not in keys:
            raise ValueError(f"{key}: expected the keys {', '.join(keys)}, found {did_you_mean(key, keys)}")
    # What is missing and has no default is None, which its check refuses in its own words.
    given = {f: found.get(key) for key, f in keys.items() if key in found or f.default is MISSING}
    return kind(**{f.name: _checked(f, value) for f, value in given.items()})


def _checked(f: Field, value: Any) -> Any:
    """A value as it is kept."""
    if value is None and f.default is None:
        return None
    try:
        return f.metadata["check"](value)
    except ValueError as error:
        raise ValueError(f"{key_of(f)}: {error}") from None


def shown(found: Any) -> str:
    """What was found, in a message."""
    text = "nothing" if found is None else repr(found)
    return text if len(text) <= _LONG else f"{text[:_LONG]} ..."


def did_you_mean(found: Any, known: Collection[str]) -> str:
    """What was found, and what of all that is known is most like it."""
    meant = get_close_matches(str(found), known, 1)
    return f"{found!r}" + (f"; did you mean {meant[0]!r}?" if meant else "")


def number(wanted: str, low: float = -_FAR, high: float = _FAR, of: Callable = float) -> Checked:
    """A number, `of` which is from `low` to `high`; also one that YAML takes for text, such as 1e-3.

    Args:
        wanted: what is expected, for messages.
        low, high: the range.
        of: what of the number has to be in it; default: the number itself.
    """

    def check(value: Any) -> float:
        try:
            found = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError, OverflowError):  # that of a whole number of hundreds of digits
            found = math.nan
        if not low <= of(found) <= high:
            raise ValueError(f"expected {wanted}, found {shown(value)}")
        return found

    return {"check": check, "wanted": wanted}


def whole(low: int, high: int) -> Checked:
    """A whole number from `low` to `high`."""
    wanted = f"a whole number from {low} to {high}"

    def check(value: Any) -> int:
        if type(value) is not int or not low <= value <= high:
            raise ValueError(f"expected {wanted}, found {shown(value)}")
        return value

    return {"check": check, "wanted": wanted}


def vector(wanted: str, least: float = 0.0) -> Checked:
    """Three numbers, of length `least` at least."""
    one, wanted = number("")["check"], f"{wanted} as [x, y, z]"

    def check(value: Any) -> Vector:
        try:
            x, y, z = (one(coordinate) for coordinate in value)
            if math.hypot(x, y, z) >= least:
                return x, y, z
        except (TypeError, ValueError):
            pass
        raise ValueError(f"expected {wanted}, found {shown(value)}")

    return {"check": check, "wanted": wanted}


def instance(kind: type, wanted: str) -> Checked:
    """A value of one type; text must not be empty."""

    def check(value: Any) -> Any:
        if not isinstance(value, kind) or value == "":
            raise ValueError(f"expected {wanted}, found {shown(value)}")
        return value

    return {"check": check, "wanted": wanted}


def part_list(value: Any) -> tuple[str | int, ...]:
    """Names and numbers of parts; one alone needs no list.

    Raises:
        ValueError: it is neither, or there is none.
    """
    listed = [value] if isinstance(value, (str, int)) else value
    sound = isinstance(listed, (list, tuple)) and len(listed) > 0
    if not sound or any(isinstance(part, bool) or not isinstance(part, (str, int)) for part in listed):
        raise ValueError(f"expected names or numbers of parts, or {ALL}, found {shown(value)}")
    return tuple(listed)
