"""The operations of edit scripts: a frozen dataclass for each, checked at construction.

A field's name is its key in scripts, except that the keys `from` and `to` are the fields `begin` and `end`,
as `from` is reserved in Python. Times are seconds of the film after the preceding edits, from 0; angles are
degrees, lengths metres.
"""

import json
import math
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from gsjax.methods.parts import edits
from gsjax.methods.parts.entries import (
    Entry,
    Vector,
    did_you_mean,
    instance,
    key_of,
    number,
    point,
    read,
    shown,
    vector,
    whole,
)
from gsjax.methods.parts.film import Film, Layer, composite, placed
from gsjax.methods.parts.operation import SECONDS, Edit, LookEdit, TimeEdit
from gsjax.methods.parts.trajectory import Trajectory

_AXIS = vector("a direction of the world", least=1e-6)
_POINT = point("a point in metres")
_DEGREES = number("degrees")
_OPACITY = number("a factor on opacities, 0 to 1", 0.0, 1.0)
_RATE = number("a factor from 0.01 to 100, or from -0.01 to -100 for backwards", 0.01, 100.0, of=abs)
_SIZE = number("a factor from 0.001 to 1000", 1e-3, 1e3)
_COMMON = {f.name for kind in (Edit, LookEdit) for f in fields(kind)}  # keys that operations share


@dataclass(frozen=True, kw_only=True)
class Speed(TimeEdit):
    """Parts move faster, slower or backwards."""

    factor: float = field(metadata=_RATE | {"example": 2})

    def end_after(self, end: float) -> float:
        begin, stop = self.interval(end)
        return max(end, stop) + (stop - begin) * (1 / abs(self.factor) - 1)

    def retimed(self, trajectory, parts, begin, end):
        return edits.speed(trajectory, parts, self.factor, begin, end, stay=self.end is None)


@dataclass(frozen=True, kw_only=True)
class Loop(TimeEdit):
    """Parts repeat their motion, `times` times or endlessly."""

    times: int | None = field(default=None, metadata=whole(1, 1000))
    bounce: bool = field(default=False, metadata=instance(bool, "true or false"))

    def end_after(self, end: float) -> float:
        begin, stop = self.interval(end)
        if self.times is None:
            return max(end, stop)
        looped = (stop - begin) * self.times * (2 if self.bounce else 1)
        follows = 0.0 if self.end is None else max(end - stop, 0.0) + (stop - begin if self.bounce else 0.0)
        return begin + looped + follows

    def retimed(self, trajectory, parts, begin, end):
        return edits.loop(trajectory, parts, begin, end, self.times, self.bounce, stay=self.end is None)


@dataclass(frozen=True, kw_only=True)
class Freeze(TimeEdit):
    """Parts stay still as they were at time `at`, and continue from there after `to`, if that is given."""

    at: float | None = field(default=None, metadata=SECONDS)

    def affected(self, trajectory: Trajectory, parts: list[int], ends: list[float]) -> list[int]:
        return parts

    def interval(self, last: float) -> tuple[float, float]:
        begin = self.begin if self.begin is not None else self.at or 0.0
        end = math.inf if self.end is None else self.end
        if not begin < end:
            raise ValueError(f"to: expected a time after {begin:g}, when parts stop, found {end:g}")
        return begin, end

    def end_after(self, end: float) -> float:
        begin, stop = self.interval(end)
        left = end - (begin if self.at is None else self.at)
        return end if stop == math.inf else stop + max(left, 0.0)

    def retimed(self, trajectory, parts, begin, end):
        return edits.freeze(trajectory, parts, self.at, begin, end)


@dataclass(frozen=True, kw_only=True)
class Isolate(Freeze):
    """Only these parts keep moving; all others freeze."""

    def affected(self, trajectory: Trajectory, parts: list[int], ends: list[float]) -> list[int]:
        return edits.others(trajectory, parts)


@dataclass(frozen=True, kw_only=True)
class Fade(LookEdit):
    """Parts become translucent, or by default invisible."""

    opacity: float = field(default=0.0, metadata=_OPACITY)

    def changed(self, layer, parts, share):
        return edits.fade(layer.trajectory, parts, self.opacity, share)


@dataclass(frozen=True, kw_only=True)
class Ghost(Fade):
    """Only these parts are shown; all others, including the background, become invisible or translucent."""

    def affected(self, trajectory: Trajectory, parts: list[int], ends: list[float]) -> list[int]:
        return edits.others(trajectory, parts)


@dataclass(frozen=True, kw_only=True)
class Scale(LookEdit):
    """Parts are scaled about their handles."""

    factor: float = field(metadata=_SIZE | {"example": 0.5})

    def changed(self, layer, parts, share):
        return edits.scale(layer.trajectory, parts, self.factor, share)


@dataclass(frozen=True, kw_only=True)
class Move(LookEdit):
    """Parts are moved `by` metres along the axes of the world."""

    by: Vector = field(metadata=vector("metres") | {"example": (0, 0, 0.1)})

    def changed(self, layer, parts, share):
        return edits.move(layer.trajectory, parts, jnp.array(self.by), share)


@dataclass(frozen=True, kw_only=True)
class Rotate(LookEdit):
    """Parts are rotated in addition to their motion, about their handles or a point of the canonical
    scene."""

    axis: Vector = field(metadata=_AXIS | {"example": (0, 0, 1)})
    degrees: float = field(metadata=_DEGREES | {"example": 30})
    about: Vector | None = field(default=None, metadata=_POINT)

    def changed(self, layer, parts, share):
        arm = _arm(layer, parts, self.about)
        return edits.rotate(layer.trajectory, parts, _turn(self.axis, self.degrees), arm, share)


@dataclass(frozen=True, kw_only=True)
class Redirect(LookEdit):
    """The motion of parts is rotated, not the parts: a lid or a drawer opens in another direction."""

    axis: Vector = field(metadata=_AXIS | {"example": (0, 0, 1)})
    degrees: float = field(metadata=_DEGREES | {"example": 30})
    about: Vector | None = field(default=None, metadata=_POINT)
    at: float | None = field(default=None, metadata=SECONDS)

    def changed(self, layer, parts, share):
        turn, arm = _turn(self.axis, self.degrees), _arm(layer, parts, self.about)
        return edits.redirect(layer.trajectory, parts, turn, arm, self.at, share)


@dataclass(frozen=True, kw_only=True)
class Amplify(LookEdit):
    """Parts move `factor` times as far from where they were at time `at`, by default the film's start."""

    factor: float = field(metadata=number("a factor from -100 to 100", -100.0, 100.0) | {"example": 1.5})
    at: float | None = field(default=None, metadata=SECONDS)

    def changed(self, layer, parts, share):
        return edits.amplify(layer.trajectory, parts, self.factor, self.at, share)


@dataclass(frozen=True, kw_only=True)
class Echo(LookEdit):
    """Copies follow parts (or precede them if `every` is negative), each fainter than the last by `fade`."""

    copies: int = field(default=3, metadata=whole(1, 100))
    every: float = field(default=0.2, metadata=number("seconds other than 0", 1e-3, 1e4, of=abs))
    fade: float = field(default=0.5, metadata=_OPACITY)

    def added_end(self, end: float) -> float:
        return min(end + max(self.copies * self.every, 0.0), math.inf if self.end is None else self.end)

    def applied(self, film: Film, parts: list[int], ends: list[float]) -> Film:
        scene, trajectory = film[0].scene, film[0].trajectory
        copies = [
            edits.echo(trajectory, parts, k * self.every, self.fade**k) for k in range(1, self.copies + 1)
        ]
        hidden = 1 - self.share(film)
        return *film, *(Layer(scene, edits.fade(copy, parts, share=hidden)) for copy in copies)


@dataclass(frozen=True, kw_only=True)
class Place(Entry):
    """The placement of parts of another scene.

    Attributes:
        to: position of the centre of their handles at the start; default: as in the other scene.
        axis, degrees, scale: their rotation and scale about that centre.
    """

    to: Vector | None = field(default=None, metadata=_POINT)
    axis: Vector = field(default=(0.0, 0.0, 1.0), metadata=_AXIS)
    degrees: float = field(default=0.0, metadata=_DEGREES)
    scale: float = field(default=1.0, metadata=_SIZE)


@dataclass(frozen=True, kw_only=True)
class Composite(LookEdit):
    """Parts of another run are added, after `edits` of their own, at their `place`."""

    from_run: str = field(metadata=instance(str, "the folder of a run") | {"example": "runs/other"})
    place: Place = field(
        default=Place(),
        metadata={
            "check": lambda value: value if isinstance(value, Place) else read(Place, value),
            "wanted": "where they are put, {to: [x, y, z], axis: [x, y, z], degrees: 90, scale: 1}",
        },
    )
    edits: tuple[Edit, ...] = field(
        default=(), metadata={"check": lambda value: read_edits(value), "wanted": "a list of edits"}
    )

    def added_end(self, end: float) -> float:
        return end if self.end is None else min(end, self.end)

    def joined(self, film: Film, other: Film, parts: list[int]) -> Film:
        """The film with `parts` of the other's first layer added, and all of its further layers."""
        first, place, hidden = other[0], self.place, 1 - self.share(film)
        handles = first.scene.centers + first.trajectory.poses.translations[0]
        middle = jnp.mean(handles[jnp.array(parts)], axis=0)
        shift = jnp.zeros(3) if place.to is None else jnp.array(place.to) - middle
        turn, everything = _turn(place.axis, place.degrees), range(first.scene.num_parts)
        faded = [Layer(at.scene, edits.fade(at.trajectory, everything, share=hidden)) for at in other]
        there = [placed(layer, turn, shift, place.scale, middle) for layer in faded]
        return *composite(film, there[0], parts), *there[1:]


OPERATIONS: dict[str, type[Edit]] = {
    kind.operation(): kind
    for kind in (
        *(Isolate, Freeze, Speed, Loop),
        *(Ghost, Fade, Echo, Composite),
        *(Scale, Move, Rotate, Redirect, Amplify),
    )
}
"""The operations by name."""
_MEANT = dict.fromkeys(("remove", "delete", "hide"), "fade with opacity 0 takes parts away")


def read_edits(found: Any, first: int = 1) -> tuple[Edit, ...]:
    """Edits from a list of mappings or edits.

    Args:
        found: the list.
        first: number of the first edit in messages.

    Raises:
        ValueError: an entry is not as expected; the message begins with its number and operation.
    """
    if not isinstance(found, (list, tuple)):
        raise ValueError(f"expected a list of edits, found {shown(found)}")
    return tuple(_read_edit(entry, number) for number, entry in enumerate(found, first))


def label(number: int, operation: str) -> str:
    """The name of an edit in messages."""
    return f"edit {number} ({operation})"


def example_line(operation: str, parts: str) -> str:
    """An example of an operation that `parse_op` reads, such as
    `echo:parts=drawer,copies=3,every=0.2,fade=0.5`, with the operation's own keys that have a simple
    value."""
    keys = {}
    for f in (f for f in fields(OPERATIONS[operation]) if f.name not in _COMMON):
        value = f.metadata["example"] if f.default is MISSING else f.default
        if value not in (None, ()) and not isinstance(value, Entry):
            keys[key_of(f)] = value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
    return ",".join([f"{operation}:parts={parts}", *(f"{key}={value}" for key, value in keys.items())])


def describe_operation(operation: str) -> list[str]:
    """A sentence that describes an operation, and lines for its keys; keys that take the same values share a
    line."""
    kind, keys = OPERATIONS[operation], {}
    for f in sorted(fields(kind), key=lambda f: f.name in _COMMON):  # otherwise in the order of declaration
        keys.setdefault(f.metadata["wanted"], []).append(key_of(f))
    sentence = " ".join((kind.__doc__ or operation).split())
    return [sentence, *(f"{', '.join(alike)}: {wanted}" for wanted, alike in keys.items())]


def _read_edit(found: Any, number: int) -> Edit:
    if isinstance(found, Edit):
        return found
    if not isinstance(found, dict) or "op" not in found:
        raise ValueError(f"edit {number}: expected a mapping with the key op, found {shown(found)}")
    name, rest = found["op"], {k: value for k, value in found.items() if k != "op"}
    if not isinstance(name, str) or name not in OPERATIONS:
        known = f"one of {', '.join(OPERATIONS)}"
        meant = _MEANT.get(str(name))
        found = f"{name!r}; {meant}" if meant else did_you_mean(name, OPERATIONS)
        raise ValueError(f"edit {number}: op: expected {known}, found {found}")
    try:
        return read(OPERATIONS[name], rest)
    except ValueError as error:
        raise ValueError(f"{label(number, name)}: {error}") from None


def _turn(axis: Vector, degrees: float) -> Float[Array, "3"]:
    """The rotation as axis times angle, radians."""
    return jnp.array(np.deg2rad(degrees) * np.array(axis) / np.linalg.norm(axis))


def _arm(layer: Layer, parts: list[int], about: Vector | None) -> Float[Array, "parts 3"] | None:
    """The vectors from the handles of parts to a point of the canonical scene, metres."""
    return None if about is None else jnp.array(about) - layer.scene.centers[jnp.array(parts)]
