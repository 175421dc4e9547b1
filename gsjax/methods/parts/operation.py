"""What every operation of an edit script is: of some parts, from a time until another; and what two kinds of
them share, those that change time (`TimeEdit`) and those that change how parts look or stand (`LookEdit`).
"""

from dataclasses import dataclass, field

from jaxtyping import Array, Float

from gsjax.methods.parts import edits
from gsjax.methods.parts.entries import Entry, number, part_list
from gsjax.methods.parts.film import Film, Layer
from gsjax.methods.parts.trajectory import Trajectory

SECONDS = number("seconds from the film's start, 0 or more", 0.0)


@dataclass(frozen=True, kw_only=True)
class Edit(Entry):
    """One operation on some parts of the film's first layer, from some time on until another.

    Attributes:
        parts: names or numbers; 0 is the background, "all" every one.
        begin, end: `from` and `to`; None is the film's own.
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
        """Its name in scripts."""
        return cls.__name__.lower()

    def concerned(self, trajectory: Trajectory, parts: list[int], lasts: list[float]) -> list[int]:
        """Which parts change, if these are named and the motion of each part of the scene ends at `lasts`."""
        return parts

    def ends(self, last: float) -> float:
        """When the motion of a part that concerns it ends, if it ended at `last`, seconds."""
        return last

    def adds_until(self, last: float) -> float:
        """When the motion ends of what it adds to the film, which is that of a part that ends at `last`."""
        return 0.0

    def edited(self, film: Film, parts: list[int], lasts: list[float]) -> Film:
        """The film after it.

        Args:
            parts: those that change.
            lasts: when the motion of each part of the first layer ends, seconds.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class TimeEdit(Edit):
    """What comes after `to` follows on, sooner or later; by default `to` is where a part's motion ends."""

    def concerned(self, trajectory: Trajectory, parts: list[int], lasts: list[float]) -> list[int]:
        """Those that still move at `from`: what is over stands still, whatever is done to all."""
        begin, last = self.begin or 0.0, max(lasts[p] for p in parts)
        moving = parts if self.end is not None else [p for p in parts if begin < lasts[p]]
        if not moving:
            parts = ", ".join(f"part {part}" if isinstance(part, int) else part for part in self.parts)
            expected = f"a time before {last:g}, where the motion of {parts} ends"
            raise ValueError(f"from: expected {expected}, found {begin:g}")
        return moving

    def edited(self, film: Film, parts: list[int], lasts: list[float]) -> Film:
        trajectory = film[0].trajectory
        for part in parts:
            trajectory = self.retimed(trajectory, [part], *self.stretch(lasts[part]))
        return Layer(film[0].scene, trajectory), *film[1:]

    def stretch(self, last: float) -> tuple[float, float]:
        """From when to when, for a part whose motion ends at `last`."""
        return self.begin or 0.0, last if self.end is None else self.end

    def retimed(self, trajectory: Trajectory, parts: list[int], begin: float, end: float) -> Trajectory:
        """The trajectory after it.

        Args:
            trajectory: of all parts.
            parts: whose time is changed.
            begin, end: between which it is, seconds.
        """
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LookEdit(Edit):
    """Holds from `from` until `to`, coming and going within `ease` seconds inside of these bounds."""

    ease: float = field(default=0.0, metadata=number("seconds, 0 or more", 0.0))

    def edited(self, film: Film, parts: list[int], lasts: list[float]) -> Film:
        return Layer(film[0].scene, self.changed(film[0], parts, self.share(film))), *film[1:]

    def share(self, film: Film) -> Float[Array, "T"]:
        """How far it holds at each moment, 0 to 1."""
        return edits.during(film[0].trajectory.times, self.begin, self.end, self.ease)

    def changed(self, layer: Layer, parts: list[int], share: Float[Array, "T"]) -> Trajectory:
        """The layer's trajectory after it.

        Args:
            layer: the scene and its trajectory.
            parts: that are changed.
            share: of the change in each frame, 0 to 1.
        """
        raise NotImplementedError
