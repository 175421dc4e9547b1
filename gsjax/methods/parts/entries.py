"""Entries of a script: frozen dataclasses whose fields' metadata define how values are checked.

`metadata["check"]` converts a value, or raises a ValueError with what was expected and what was found.
`metadata["wanted"]` describes valid values, `metadata["key"]` is the field's name in scripts if it differs,
and `metadata["example"]` is an example for a field without a default.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import MISSING, Field, dataclass, fields, replace
from difflib import get_close_matches
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

ALL = "all"
"""Stands for all parts, including the background."""
Vector = tuple[float, ...]
Checked = dict[str, Any]
"""Metadata of a field."""
_LONG = 200  # characters of a value that a message shows at most
_FAR = 1e6  # more metres, degrees or seconds than anybody means
_EARTH = 1e8  # farther than any coordinates of places on earth reach, metres


@dataclass(frozen=True, kw_only=True)
class Entry:
    """An entry, whose fields are checked at construction; a field whose default is None may be None.

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
        ValueError: it is not a mapping, a key is unknown or missing, or a value is not as expected.
    """
    keys = {key_of(f): f for f in fields(kind)}
    if not isinstance(found, dict):
        raise ValueError(f"expected the keys {', '.join(keys)}, found {shown(found)}")
    for key in found:
        if key not in keys:
            raise ValueError(f"{key}: expected one of {', '.join(keys)}, found {did_you_mean(key, keys)}")
    # A missing field without default is None, which its check refuses with its own message.
    given = {f: found.get(key) for key, f in keys.items() if key in found or f.default is MISSING}
    return kind(**{f.name: _checked(f, value) for f, value in given.items()})


def _checked(f: Field, value: Any) -> Any:
    """A field's value, checked and converted."""
    if value is None and f.default is None:
        return None
    try:
        return f.metadata["check"](value)
    except ValueError as error:
        raise ValueError(f"{key_of(f)}: {error}") from None


def shown(found: Any) -> str:
    """A value as messages show it."""
    text = "nothing" if found is None else repr(found)
    return text if len(text) <= _LONG else f"{text[:_LONG]} ..."


def did_you_mean(found: Any, known: Collection[str]) -> str:
    """A value as messages show it, with the most similar known name."""
    meant = get_close_matches(str(found), known, 1)
    return f"{found!r}" + (f"; did you mean {meant[0]!r}?" if meant else "")


def number(wanted: str, low: float = -_FAR, high: float = _FAR, of: Callable = float) -> Checked:
    """A number in a range; also one that YAML reads as text, such as 1e-3.

    Args:
        wanted: description for messages.
        low, high: the range.
        of: function of the number that must be in the range, such as `abs`; default: the number itself.
    """

    def check(value: Any) -> float:
        try:
            found = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError, OverflowError):  # an integer of hundreds of digits
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


def vector(wanted: str, least: float = 0.0, far: float = _FAR) -> Checked:
    """A vector of three numbers.

    Args:
        wanted: description for messages.
        least: its least length.
        far: how far from 0 each number may be.
    """
    one, wanted = number("", -far, far)["check"], f"{wanted} as [x, y, z]"

    def check(value: Any) -> Vector:
        try:
            x, y, z = (one(coordinate) for coordinate in value)
            if math.hypot(x, y, z) >= least:
                return x, y, z
        except (TypeError, ValueError):
            pass
        raise ValueError(f"expected {wanted}, found {shown(value)}")

    return {"check": check, "wanted": wanted}


def point(wanted: str) -> Checked:
    """A point in the coordinates of the data, which may be far from 0 (UTM, or earth-centred)."""
    return vector(wanted, far=_EARTH) | {"point": True}


def relative(entry: Kind, origin: Float[np.ndarray, "3"] | None) -> Kind:
    """An entry, with its points and those of nested entries relative to an origin; unchanged without one."""
    if origin is None:
        return entry
    changed = {}
    for f in fields(entry):
        value = getattr(entry, f.name)
        if isinstance(value, Entry):
            changed[f.name] = relative(value, origin)
        elif f.metadata.get("point") and value is not None:
            changed[f.name] = tuple((np.array(value) - origin).tolist())
        elif isinstance(value, tuple):
            changed[f.name] = tuple(relative(e, origin) if isinstance(e, Entry) else e for e in value)
    return replace(entry, **changed)


def instance(kind: type, wanted: str) -> Checked:
    """A value of the given type; text must not be empty."""

    def check(value: Any) -> Any:
        if not isinstance(value, kind) or value == "":
            raise ValueError(f"expected {wanted}, found {shown(value)}")
        return value

    return {"check": check, "wanted": wanted}


def part_list(value: Any) -> tuple[str | int, ...]:
    """Names and numbers of parts; a single one needs no list.

    Raises:
        ValueError: the value is neither, or the list is empty.
    """
    listed = [value] if isinstance(value, (str, int)) else value
    sound = isinstance(listed, (list, tuple)) and len(listed) > 0
    if not sound or any(isinstance(part, bool) or not isinstance(part, (str, int)) for part in listed):
        raise ValueError(f"expected names or numbers of parts, or {ALL}, found {shown(value)}")
    return tuple(listed)
