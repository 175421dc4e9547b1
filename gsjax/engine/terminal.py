"""A summary in the terminal: its brief tables, its cards, and where the report is."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as Grid
from rich.text import Text

from gsjax.engine.summary import ARROWS, Card, Column, Summary, Table

_WIDE = 130  # columns of a terminal that has room for every column of a table
_ENDLESS = 10_000  # columns of a log: programs search it, so it keeps its lines whole


def print_summary(
    summary: Summary, report: Path | None, *, notes: bool = False, titles: bool = False
) -> None:
    """Print a summary on stdout.

    Args:
        summary: the outcome of a run.
        report: the page that shows all of it; None if none was written.
        notes: print its notes too.
        titles: print the titles of its tables too.
    """
    console = _console()
    console.print()
    for table in summary.tables:
        if table.brief and table.rows:
            if titles:
                console.print(Text(table.title, style="bold"))
            _print_columns(console, table)
    if summary.cards:
        console.print(_cards(summary.cards))
    if summary.subtitle:
        console.print(Text(summary.subtitle, style="dim"), soft_wrap=not console.is_terminal)
    for note in summary.all_notes if notes else ():
        console.print(Text(note, style="dim"), soft_wrap=not console.is_terminal)
    if not summary.complete:
        how = "--resume continues it" if summary.resumable else "--overwrite starts again: nothing was saved"
        console.print(f"[bold yellow]partial run[/]; the same command with {how}")
    lines = [*summary.hints, *([] if report is None else [("report", str(report))])]
    for label, text in lines:
        console.print(Text.assemble((label, "bold"), "  ", text), soft_wrap=True)


def print_table(table: Table) -> None:
    """Print a table on stdout, below its title."""
    console = _console()
    console.print(Text(f"\n{table.title}", style="bold"))
    _print_columns(console, table)


def print_facts(facts: Mapping[str, str], title: str = "") -> None:
    """Print facts on stdout below a title, a line each, with their names in bold."""
    console = _console()
    if title:
        console.print(Text(title, style="bold cyan"))
    console.print(_facts(facts))


def format_bytes(size: int) -> str:
    """A size in bytes as text: "12.3 MB"."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _facts(facts: Mapping[str, str]) -> Grid:
    grid = Grid.grid(padding=(0, 3, 0, 0))
    for name, text in facts.items():
        grid.add_row(Text(name, style="bold"), Text(text, overflow="fold"))
    return grid


def _cards(cards: Sequence[Card]) -> Grid:
    return _facts({card.head: f"{card.text} {card.unit}".strip() for card in cards})


def _console() -> Console:
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = _ENDLESS
    return console


def _print_columns(console: Console, table: Table) -> None:
    """Print a table; columns for which there is no room follow below, beside the first column again."""
    room = console.width
    columns = [column for column in table.shown if room >= _WIDE or not column.wide]
    first, others = columns[:1], columns[1:]
    endless = console.options.update_width(_ENDLESS)
    while True:
        for count in range(len(others), -1, -1):
            grid = _grid(table, [*first, *others[:count]], room)
            if count <= 1 or Measurement.get(console, endless, grid).maximum <= room:
                break
        console.print(grid)
        others = others[count:]
        if not others:
            return


def _grid(table: Table, columns: Sequence[Column], room: int) -> Grid:
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    units = any(column.unit or column.better for column in columns)
    for column in columns:
        grid.add_column(
            _head(column, units),
            justify="right" if table.is_numeric(column) else "left",
            overflow="fold",
            max_width=room // 2 if column is columns[0] and len(columns) > 1 else None,
        )
    for i, row in enumerate(table.rows):
        styles = ("bold green" if (i, column.key) in table.best else "" for column in columns)
        grid.add_row(*map(Text, (column.text(row) for column in columns), styles))
    if table.means:
        grid.add_section()
    for row in table.means:
        grid.add_row(*(Text(column.text(row)) for column in columns), style="bold")
    grid.add_row()
    return grid


def _head(column: Column, units: bool) -> Text:
    """The heading in two lines, and the unit in a third where any column has one."""
    first, _, rest = column.head.partition(" ")
    head = Text(f"{first}\n{rest}" if rest else f"\n{first}")
    if units:
        head.append(f"\n{column.unit}{ARROWS[column.better]}", style="dim")
    return head
