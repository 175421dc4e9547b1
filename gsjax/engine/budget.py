"""The time budget of a command (--minutes): for its steps, then for scores, pictures and the report."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from gsjax.engine.messages import Notes

Item = TypeVar("Item")
REPORT_S = 3.0
"""Seconds for the last files and the report."""
_REST = 0.15  # largest share of the time that is kept for what follows the steps
_LEAST = 0.25  # smallest share of the time that steps are given
_LOADING_S = 2.5  # in which the program starts, before it has parsed its arguments


class Budget:
    """The minutes of a command, from its beginning to its end.

    Attributes:
        minutes: for the whole command; None for no limit.
        rest_s: the most seconds available for what follows the steps (15 % of all) -> the seconds that it is
            expected to take.
        hurried: whether only what is necessary should still be done, as after Ctrl-C.
    """

    def __init__(self, minutes: float | None, begun: float):
        """
        Args:
            minutes: for the whole command; None for no limit.
            begun: its start time, by `time.perf_counter`.
        """
        self.minutes, self.hurried = minutes, False
        self.rest_s: Callable[[float], float] = lambda most: most
        self._begun, self._steps, self._most = begun - _LOADING_S, begun, 0.0

    def check_exceeds(self, earlier: float) -> None:
        """Raises ValueError if the `earlier` seconds of steps, of the run to resume, used up all the time."""
        if self.minutes is not None and earlier >= 60 * self.minutes:
            raise ValueError(
                f"--minutes {self.minutes:g}: the steps of the run to resume took {_clock(earlier)} already; "
                "give more minutes, of which they count as a part"
            )

    def begin_steps(self, earlier: float, console: Console) -> None:
        """Start the time for steps, and print how the time is divided.

        Args:
            earlier: seconds of steps in the run that is resumed; they count.
            console: where to print.
        """
        self._begun -= earlier
        self._steps = perf_counter() - earlier
        if self.minutes is not None:
            total, used, kept = map(_clock, (60 * self.minutes, self.used, _REST * 60 * self.minutes))
            console.print(
                f"[bold]time[/]  {total} in all; {used} are used, and at most {kept} are kept for scores, "
                "pictures and the report",
                soft_wrap=True,
            )

    @property
    def used(self) -> float:
        """Seconds since the beginning."""
        return perf_counter() - self._begun

    @property
    def left(self) -> float:
        """Seconds until the command has to end."""
        return float("inf") if self.minutes is None else 60 * self.minutes - self.used

    @property
    def share(self) -> float:
        """The used share of the time for steps, which never decreases; 0 without a limit."""
        if self.minutes is not None:
            self._most = max(self._most, (perf_counter() - self._steps) / self._given_s())
        return self._most

    @property
    def steps_s(self) -> float:
        """Seconds that are left for steps."""
        return float("inf") if self.minutes is None else self._given_s() * (1 - self.share)

    def _given_s(self) -> float:
        """Seconds for steps."""
        total = 60 * (self.minutes or 0.0)
        given = total - self.rest_s(_REST * total) - (self._steps - self._begun)
        return max(given, _LEAST * total)

    @property
    def is_over(self) -> bool:
        """Whether the time for steps is used up."""
        return self.share >= 1

    def allows(self, seconds: float, keep: float = REPORT_S) -> bool:
        """Whether there is time for an optional task of `seconds`, with `keep` seconds left after it."""
        return not self.hurried and bool(self.left >= seconds + keep)

    def guarded(self, items: Iterable[Item], keep: float) -> Iterator[Item]:
        """Yields the items, all of which are needed.

        Args:
            items: what is processed, one after another.
            keep: seconds to be left after them.

        Raises:
            TimeoutError: the time runs out before all are processed.
        """
        for item in items:
            if self.left < keep:
                raise TimeoutError("no time was left for it")
            yield item

    def affordable(self, items: Sequence[Item]) -> Iterator[Item]:
        """Yields the items in order: all of them, or as many as there is time for before the report, evenly
        spread and at least one. The first may take longer than the others, because it compiles."""
        took = 0.0
        for item in items[:2]:
            begun = perf_counter()
            yield item
            took = perf_counter() - begun
            if self.left < REPORT_S + took:
                return
        rest = items[2:]
        count = min(float(len(rest)), (self.left - REPORT_S) / max(took, 1e-9))
        for i in np.unique(np.linspace(0, len(rest) - 1, int(count)).round().astype(int)):
            if self.left < REPORT_S:
                return
            yield rest[i]


def note_if_few(scored: Sequence[Any], held_out: Sequence[Any], what: str, notes: Notes) -> None:
    """Note if fewer rows were `scored` than `held_out`, for want of time; `what` names them in `notes`."""
    if 0 < len(scored) < len(held_out):  # none, if Ctrl-C or an error ended it
        notes.add(f"{len(scored)} of {len(held_out)} {what} were scored: --minutes left no time for more.")


def _clock(seconds: float) -> str:
    return f"{seconds / 60:.3g} min" if seconds >= 100 else f"{seconds:.0f} s"
