"""Tables of a run: the same columns for the terminal and for the report's page."""

from typing import Any, NamedTuple

from rich.table import Table as Grid

from gsjax.engine.report import Table, format_number


class Column(NamedTuple):
    """A column of a table: its head, the metric in it, the unit, and digits behind the point."""

    head: str
    key: str
    unit: str = ""
    decimals: int | None = None


def grid(columns: tuple[Column, ...], rows: list[dict[str, Any]]) -> Grid:
    """The columns in which something stands, for the terminal."""
    drawn = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    shown = _shown(columns, rows)
    for column in shown:
        text = any(isinstance(row.get(column.key), str) for row in rows)
        *first, last = column.head.split(" ", 1)
        head = "\n".join([*first, last] if first else ["", last])
        unit = f"\n[dim]{column.unit}[/]" if any(c.unit for c in shown) else ""
        drawn.add_column(head + unit, justify="left" if text else "right", no_wrap=True)
    for row in rows:
        drawn.add_row(*(format_number(row.get(c.key), c.decimals) for c in shown))
    drawn.add_row()
    return drawn


def table(title: str, columns: tuple[Column, ...], rows: list[dict[str, Any]], note: str) -> list[Table]:
    """The table with the columns in which something stands; none if there are no rows.

    Args:
        title: of the table.
        columns: all that there may be.
        rows: values by the columns' keys.
        note: below it.
    """
    if not rows:
        return []
    shown = _shown(columns, rows)
    cells = [[row.get(c.key) for c in shown] for row in rows]
    heads, units = [c.head for c in shown], [c.unit for c in shown]
    return [Table(title, heads, cells, units, note, [c.decimals for c in shown])]


def time_table(times: tuple[tuple[str, str], ...], seconds: dict[str, float]) -> Table:
    """Where time went: `times` has the name of each stage, and what it does."""
    rows = [[says, seconds.get(name)] for name, says in times]
    return Table("Time", ("what", "time"), rows, ("", "s"), decimals=(None, 2))


def _shown(columns: tuple[Column, ...], rows: list[dict[str, Any]]) -> list[Column]:
    """The columns in which something stands."""
    return [column for column in columns if any(row.get(column.key) is not None for row in rows)]
