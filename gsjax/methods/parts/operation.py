"""Base classes of the operations of an edit script: `Edit`, an operation on some parts over an interval;
`TimeEdit`, which changes time; and `LookEdit`, which changes the pose or appearance of parts."""

from dataclasses import dataclass, field

from jaxtyping import Array, Float

from gsjax.methods.parts import edits
from gsjax.methods.parts.entries import Entry, number, part_list
from gsjax.methods.parts.film import Film, Layer
from gsjax.methods.parts.trajectory import Trajectory

SECONDS = number("seconds from the film's start, 0 or more", 0.0)


@dataclass(frozen=True, kw_only=True)
class Edit(Entry):
    """An operation on some parts of the film's first layer, over an interval of time.

    Attributes:
        parts: names or numbers; 0 is the background, "all" every part.
        begin, end: `from` and `to`, seconds; None: those of the film.
    """

    parts: tuple[str | int, ...] = field(
        metadata={"check": part_list, "wanted": "a name, a number, all, or several as [drawer, 2]"}
    )
    begin: float | None = field(default=None, metadata=SECONDS | {"key": "from"})
    end: float | None = field(default=None, metadata=SECONDS | {"key": "to"})

    def __post_init__(self):
        super().__post_init__()
        if self.begin is not None and self.end is not None and not self.begin < self.end:
            raise ValueError(f"to: expected a time after from, {self.begin:g}, found {self.end:g}")

    @classmethod
    def operation(cls) -> str:
        """The name of the operation in scripts."""
        return cls.__name__.lower()

    def affected(self, trajectory: Trajectory, parts: list[int], ends: list[float]) -> list[int]:
        """The parts that change if `parts` are named; `ends` has the time at which the motion of each part of
        the scene ends."""
        return parts

    def end_after(self, end: float) -> float:
        """The end of an affected part's motion after the edit, if it was `end` before, seconds."""
        return end

    def added_end(self, end: float) -> float:
        """The end of the motion that the edit adds to the film, from a part whose motion ends at `end`."""
        return 0.0

    def applied(self, film: Film, parts: list[int], ends: list[float]) -> Film:
        """The film after the edit.

        Args:
            film: the film before.
            parts: the parts that change.
            ends: the end of the motion of each part of the first layer, seconds.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class TimeEdit(Edit):
    """An edit of time. The motion after `to` follows it; `to` defaults to the end of the part's motion."""

    def affected(self, trajectory: Trajectory, parts: list[int], ends: list[float]) -> list[int]:
        """The parts that still move at `from`; the others stay still."""
        begin, last = self.begin or 0.0, max(ends[p] for p in parts)
        moving = parts if self.end is not None else [p for p in parts if begin < ends[p]]
        if not moving:
            told = ", ".join(f"part {part}" if isinstance(part, int) else part for part in self.parts)
            expected = f"a time before {last:g}, where the motion of {told} ends"
            raise ValueError(f"from: expected {expected}, found {begin:g}")
        return moving

    def applied(self, film: Film, parts: list[int], ends: list[float]) -> Film:
        trajectory = film[0].trajectory
        for part in parts:
            trajectory = self.retimed(trajectory, [part], *self.interval(ends[part]))
        return Layer(film[0].scene, trajectory), *film[1:]

    def interval(self, last: float) -> tuple[float, float]:
        """Begin and end of the edit, for a part whose motion ends at `last`, seconds."""
        return self.begin or 0.0, last if self.end is None else self.end

    def retimed(self, trajectory: Trajectory, parts: list[int], begin: float, end: float) -> Trajectory:
        """The trajectory with `parts` edited from `begin` to `end`, seconds."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LookEdit(Edit):
    """An edit of pose or appearance, from `from` until `to`, with smooth transitions of `ease` seconds."""

    ease: float = field(default=0.0, metadata=number("seconds, 0 or more", 0.0))

    def applied(self, film: Film, parts: list[int], ends: list[float]) -> Film:
        return Layer(film[0].scene, self.changed(film[0], parts, self.share(film))), *film[1:]

    def share(self, film: Film) -> Float[Array, "T"]:
        """How far the edit is applied at each moment, 0 to 1."""
        return edits.during(film[0].trajectory.times, self.begin, self.end, self.ease)

    def changed(self, layer: Layer, parts: list[int], share: Float[Array, "T"]) -> Trajectory:
        """The layer's trajectory with `parts` edited, by a `share` of 0 to 1 at each moment."""
        raise NotImplementedError
