"""The outcome of a run as one value, which the terminal, report.html and `gsjax compare` all display."""

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gsjax.data.open import SIMULATED_SCENES
from gsjax.engine.machine import in_words

Metrics = Mapping[str, Any]
"""The contents of a run's metrics.json."""
Better = Literal["more", "less"]
ARROWS: dict[Better | None, str] = {"more": " ↑", "less": " ↓", None: ""}


class Column(NamedTuple):
    """A column of a table.

    Attributes:
        head: its heading.
        key: key of its values in the rows.
        unit: shown small below the heading.
        decimals: digits after the decimal point of fractions; None for three significant digits.
        wide: whether only wide terminals show it (80 columns have no room for it).
        better: which of two values is better; None if neither.
    """

    head: str
    key: str
    unit: str = ""
    decimals: int | None = None
    wide: bool = False
    better: Better | None = None

    def text(self, row: Mapping[str, Any]) -> str:
        """The cell of a row, as it is shown."""
        return format_number(row.get(self.key), self.decimals)


class Score(NamedTuple):
    """A headline figure of a method: a card of its report, and a column of `gsjax compare`.

    Attributes:
        head, key, unit, decimals, better: of its column.
        value: metrics.json -> the number; None where there is none.
        of: what two runs must share for it to be comparable: the data; the data and the held-out views; or
            these and the machine.
    """

    head: str
    key: str
    unit: str
    decimals: int | None
    better: Better | None
    value: Callable[[Metrics], Any]
    of: Literal["data", "views", "machine"] = "data"

    @property
    def column(self) -> Column:
        """The column of a comparison."""
        return Column(self.head, self.key, self.unit, self.decimals, better=self.better)


class Card(NamedTuple):
    """A headline figure: its name, the value, the unit, and digits after the decimal point."""

    head: str
    value: Any
    unit: str = ""
    decimals: int | None = None

    @property
    def text(self) -> str:
        """The value as it is shown, without its unit."""
        return format_number(self.value, self.decimals)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        title: stands above it.
        columns: all possible columns; those without any value are not shown.
        rows: values of each row by the columns' keys; a missing value or None is shown as a dash.
        note: a line below the table.
        means: closing rows, which stand out.
        best: (index of a row, key) of cells that stand out.
        colors: one per row, RGB 0 to 255: the colour of the row's subject in videos; empty for none.
        brief: whether the terminal shows it too.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Mapping[str, Any]]
    note: str = ""
    means: Sequence[Mapping[str, Any]] = ()
    best: Collection[tuple[int, str]] = ()
    colors: Sequence[tuple[int, int, int]] = ()
    brief: bool = False

    def __post_init__(self):
        if self.colors and len(self.colors) != len(self.rows):
            raise ValueError(f"Table {self.title!r}: {len(self.colors)} colors for {len(self.rows)} rows")
        keys = {column.key for column in self.columns}
        for row, key in self.best:
            if key not in keys or not 0 <= row < len(self.rows):
                raise ValueError(f"Table {self.title!r}: no cell {key!r} in row {row}")

    @property
    def shown(self) -> list[Column]:
        """The columns in which some row has a value."""
        return [c for c in self.columns if any(row.get(c.key) is not None for row in self.rows)]

    def is_numeric(self, column: Column) -> bool:
        """Whether a column holds anything but text."""
        values = (row.get(column.key) for row in self.rows)
        return any(value is not None and not isinstance(value, str) for value in values)


class Media(NamedTuple):
    """An image, video or plot to embed, and its caption."""

    path: Path
    caption: str = ""


@dataclass(frozen=True)
class Summary:
    """The outcome of a run, or of a comparison of runs.

    Attributes:
        title: what was made from which data.
        subtitle: how, and with how much.
        cards: headline figures.
        tables: figures in detail; those without rows are not shown.
        videos, plots, images: media, by kind.
        strips: images of several pictures side by side, one below the other.
        notes: what was not scored and why, and warnings.
        machine: description of the machine from metrics.json, shown as the last note; None for none.
        hints: (label, command): what to do next.
        complete: False for a run that was stopped.
        resumable: False for a stopped run that saved nothing to resume from.
    """

    title: str
    subtitle: str = ""
    cards: Sequence[Card] = ()
    tables: Sequence[Table] = ()
    videos: Sequence[Media] = ()
    plots: Sequence[Media] = ()
    images: Sequence[Media] = ()
    strips: Sequence[Media] = ()
    notes: Sequence[str] = ()
    machine: Mapping[str, Any] | None = None
    hints: Sequence[tuple[str, str]] = ()
    complete: bool = True
    resumable: bool = True

    @property
    def all_notes(self) -> list[str]:
        """The notes, and the machine."""
        return [*self.notes, *([] if self.machine is None else [f"Machine: {in_words(self.machine)}."])]


def cards_of(scores: Iterable[Score], found: Metrics) -> list[Card]:
    """The scores of a run that are known, as cards."""
    values = ((score, score.value(found)) for score in scores)
    return [Card(s.head, value, s.unit, s.decimals) for s, value in values if value is not None]


def at(*names: str) -> Callable[[Metrics], Any]:
    """A `Score.value` that reads the value at a path in metrics.json; None if there is none."""

    def value(found: Metrics) -> Any:
        node: Any = found
        for name in names:
            node = node.get(name) if isinstance(node, Mapping) else None
        return node

    return value


def minutes(stage: str = "steps") -> Callable[[Metrics], float]:
    """A `Score.value`: minutes of a stage that repeats a step, compilation included."""

    def value(found: Metrics) -> float:
        return (found["seconds"][stage] + found["seconds"]["compile"]) / 60

    return value


def title_of(dataset: str) -> str:
    """The name of a dataset for people: "tabletop, seed 0" for the built-in scene tabletop_seed0."""
    return re.sub(rf"^({'|'.join(SIMULATED_SCENES)})(.*)_seed(\d+)$", r"\1\2, seed \3", dataset)


def time_table(times: Mapping[str, str], seconds: Mapping[str, float]) -> Table:
    """Where the time went.

    Args:
        times: the stages in their order, with what each does.
        seconds: of each.
    """
    rows = [{"stage": words, "seconds": seconds.get(name)} for name, words in times.items()]
    return Table("Time", (Column("stage", "stage"), Column("time", "seconds", "s", 2)), rows)


def format_number(value: Any, decimals: int | None = None) -> str:
    """The text of a cell: three digits for fractions, thin spaces between thousands, a dash for nothing.

    With `decimals`, fractions have that many digits after the decimal point, so that a column lines up.
    """
    if value is None:
        return "–"
    if isinstance(value, (str, bool)):
        return str(value)
    if isinstance(value, int) or (hasattr(value, "dtype") and value.dtype.kind in "iu"):
        return f"{int(value):,}".replace(",", "\u202f")
    value = float(value)
    if not math.isfinite(value):
        return "–"
    if decimals is not None:
        value = round(value, decimals) + 0.0  # no minus before a zero
        return f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")
    if value != 0 and not 1e-3 <= abs(value) < 1e6:
        return f"{value:.2e}".replace("-", "−")
    decimals = 0 if value == 0 else max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{decimals}f}".replace(",", "\u202f").replace("-", "−")
