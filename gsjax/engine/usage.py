"""How `--help` shows the options of commands, and the error message for an option that does not exist."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from itertools import pairwise, takewhile
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NUMBERS = re.compile(rf"{_NUMBER}(?:,{_NUMBER})+")
_OMITTED = (None, False, ())  # defaults that the help text explains, or that mean "not given"


def plain_help() -> ConstructorRegistry:
    """Rules that make tyro wrap help texts only once, and leave out defaults that say nothing."""
    registry, within = ConstructorRegistry(), []

    @registry.struct_rule
    def of_dataclass(info: StructTypeInfo) -> StructConstructorSpec | None:
        if not is_dataclass(info.type) or info.type in within:
            return None
        within.append(info.type)  # tyro's own rule answers the second time
        try:
            found = ConstructorRegistry.get_struct_spec(info)
        finally:
            within.pop()
        if not isinstance(found, StructConstructorSpec):
            return None
        return replace(found, fields=tuple(map(_plain, found.fields)))

    return registry


def expect_known(kind: Any, command: str, arguments: Sequence[str]) -> None:
    """Check that the options of a command line exist.

    Args:
        kind: the command's options, a dataclass or a union of them.
        command: its name, for the message.
        arguments: the arguments after the name.

    Raises:
        ValueError: one does not exist; the message suggests similar ones.
    """
    known = _options(kind)
    for before, argument in pairwise(("", *takewhile(lambda argument: argument != "--", arguments))):
        given = argument.split("=")[0].replace("_", "-")
        is_value = known.get(before.replace("_", "-"), bool) is not bool and given[:2] != "--"
        if (
            re.match("--?[a-zA-Z]", given)
            and given not in (*known, "-h", "--help")
            and not is_value
            and not given.startswith("--tyro")
        ):
            meant = " or ".join(_similar(given, [*known]))
            hint = f"; did you mean {meant}?" if meant else ";"
            raise ValueError(f"{given}: no such option{hint} gsjax {command} --help lists all")


def _plain(field: StructFieldSpec) -> StructFieldSpec:
    """The field without the source's line breaks in its help text, or a default that says nothing."""
    kind, unsaid = field.type, any(field.default is value for value in _OMITTED)
    if unsaid:
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    if field.default is None:  # None means not given: nobody needs to write it
        kind = tyro.conf.DisallowNone[kind]
    return replace(field, type=kind, helptext=_one_paragraph(field.helptext))


def _one_paragraph(text: str | Callable[[], str | None] | None) -> Callable[[], str | None]:
    """A function that returns the text without line breaks, only when it is needed: finding it is slow."""

    def joined() -> str | None:
        found = text() if callable(text) else text
        return None if found is None else " ".join(found.split())

    return joined


def without_commas(kind: Any, arguments: Sequence[str]) -> list[str]:
    """A command line in which comma-separated numbers, `--read.K 525,525,320,240`, are split into words.

    Args:
        kind, arguments: as for `expect_known`.
    """
    types, option, found = _options(kind), "", []
    for argument in arguments:
        name, _, value = argument.partition("=")
        option = name.replace("_", "-") if name.startswith("--") else option
        is_list = get_origin(types.get(option)) is tuple and {*get_args(types[option])} & {int, float}
        if is_list and _NUMBERS.fullmatch(value if name.startswith("--") else argument):
            found += [*([name] if name.startswith("--") else []), *(value or argument).split(",")]
        else:
            found.append(argument)
    return found


@cache
def _options(kind: Any) -> dict[str, Any]:
    """The types of the options of a command by their names."""
    members = get_args(kind) or (kind,)
    return {name: of for member in members for name, of in _named(member)}


def _named(kind: type, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """The options of a dataclass, those of its groups included, with their types."""
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        group, *marks = get_args(hints[field.name]) or (hints[field.name],)
        flat = tyro.conf.OmitArgPrefixes in marks or any(getattr(mark, "name", None) == "" for mark in marks)
        name = prefix + field.name.replace("_", "-")
        if is_dataclass(group):
            yield from _named(group, prefix if flat else f"{name}.")
        else:
            yield name, _listed(hints[field.name])
            if group is bool:  # where it is on by default, its option turns it off
                yield name.replace(prefix, f"{prefix}no-", 1), bool


def _listed(hint: Any) -> Any:
    """The tuple type in a type hint that may be annotated or optional; else the hint."""
    inner = (
        [_listed(each) for each in get_args(hint)]
        if get_origin(hint) in (Annotated, Union, UnionType)
        else []
    )
    return next((each for each in inner if get_origin(each) is tuple), hint)


def _similar(given: str, known: Sequence[str]) -> list[str]:
    """The known options most like the given one, with or without the names of their groups."""
    last = [f"--{name.removeprefix('--').split('.')[-1]}" for name in known]
    close = get_close_matches(given, [*known, *last], 1, 0.7)
    return [name for name, short in zip(known, last, strict=True) if name in close or short in close]
