"""How an edit is written in one line, for those who do not know yet: a line to begin with, and its keys."""

import json
from dataclasses import MISSING, Field, fields
from typing import Any

from gsjax.methods.parts.entries import Entry, key_of
from gsjax.methods.parts.operation import Edit, LookEdit
from gsjax.methods.parts.operations import OPERATIONS

_COMMON = {f.name for kind in (Edit, LookEdit) for f in fields(kind)}  # what an operation shares with others


def first_line(operation: str, parts: str) -> str:
    """A line that `parse_op` takes, such as `echo:parts=drawer,copies=3,every=0.2,fade=0.5`: with the keys
    that are the operation's own, as far as they have a plain value."""
    values = {key_of(f): _value(f) for f in fields(OPERATIONS[operation]) if f.name not in _COMMON}
    plain = {key: value for key, value in values.items() if _plain(value)}
    return ",".join([f"{operation}:parts={parts}", *(f"{key}={_written(plain[key])}" for key in plain)])


def explained(operation: str) -> list[str]:
    """What an operation does, in a sentence, and then what its keys want: those alike in one line."""
    kind, keys = OPERATIONS[operation], {}
    for f in sorted(fields(kind), key=lambda f: f.name in _COMMON):  # else as they are declared
        keys.setdefault(f.metadata["wanted"], []).append(key_of(f))
    does = " ".join((kind.__doc__ or operation).split())
    return [does, *(f"{', '.join(alike)}: {wanted}" for wanted, alike in keys.items())]


def _value(f: Field) -> Any:
    return f.metadata["example"] if f.default is MISSING else f.default


def _plain(value: Any) -> bool:
    nested = isinstance(value, Entry) or value == ()
    return value is not None and not nested


def _written(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
