"""The table of an experiment, and the remarks below it."""

from itertools import chain
from statistics import fmean, stdev
from typing import Any, NamedTuple

from gsjax.engine import machine
from gsjax.engine.experiments.config import Column
from gsjax.engine.experiments.sweep import Cell, Experiment, in_words
from gsjax.engine.summary import format_number

ARROWS = {"lower": " ↓", "higher": " ↑", "": ""}


class Shown(NamedTuple):
    """The table, as text."""

    heads: list[str]
    lines: list[list[str]]
    numeric: list[bool]  # which columns hold numbers


def tabulate(experiment: Experiment, rows: list[dict[str, Any]]) -> Shown:
    """A line per combination of options, in the order of the sweep."""
    swept = list(dict.fromkeys(chain(*(cell.options for cell in experiment.cells))))
    columns = [*map(Column, swept), *_columns(experiment, rows)]
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(in_words(row[key]) if key in row else "–" for key in swept), []).append(row)
    num_seeds, judged = len(experiment.config.seeds), columns[len(swept) :]
    lines = [
        [*words, *(figures(column, [row.get(column.key) for row in group], num_seeds) for column in judged)]
        for words, group in groups.items()
    ]
    heads = [(c.label or c.key) + (f" [{c.unit}]" if c.unit else "") + ARROWS[c.direction] for c in columns]
    numeric = [any(type(row.get(c.key)) in (int, float) for row in rows) for c in columns]
    return Shown(heads, lines, numeric)


def _columns(experiment: Experiment, rows: list[dict[str, Any]]) -> tuple[Column, ...]:
    """The columns of the config, else one per figure that is not a list."""
    known = {key for cell in experiment.cells for key in cell.words} | {"seconds"}
    plain = (key for row in rows for key, value in row.items() if not isinstance(value, (list, dict)))
    return experiment.columns or tuple(Column(key) for key in dict.fromkeys(plain) if key not in known)


def figures(column: Column, values: list[Any], num_seeds: int) -> str:
    """One cell of the table: a figure, or mean ± standard deviation over the seeds.

    Args:
        column: with the format of figures.
        values: the figures of the seeds that have been run.
        num_seeds: number of seeds in the sweep.
    """
    numbers = [value for value in values if isinstance(value, (int, float))]
    if not numbers:
        return " / ".join(dict.fromkeys(in_words(value) for value in values if value is not None)) or "–"
    form = (lambda value: format(value, column.format)) if column.format else format_number
    text = form(numbers[0]) if len(numbers) == 1 else f"{form(fmean(numbers))} ± {form(stdev(numbers))}"
    return text if len(numbers) == num_seeds else f"{text} ({len(numbers)}/{num_seeds})"


def remarks(experiment: Experiment, records: list[dict[str, Any]], done: list[dict[str, Any]]) -> list[str]:
    """Remarks on the table, one sentence each.

    Args:
        experiment: the experiment.
        records: the records of all cells that were run.
        done: the records in the table.
    """
    config, num_cells, notes = experiment.config, len(experiment.cells), []
    if len(config.seeds) > 1:
        n = len(config.seeds)
        notes.append(f"Mean ± standard deviation over {n} seeds; (k/{n}) where only k gave a number.")
    if len(done) < num_cells:
        notes.append(f"Not complete: {len(done)} of {num_cells} cells are done.")
    failed = [record for record in records if record["error"] is not None]
    notes += [f"Failed: {Cell(r['options'], r['seed'])}: {r['error']}" for r in failed]
    if stale := sum(record["script"] != experiment.fingerprint for record in done):
        notes.append(
            f"Stale: {stale} of {len(done)} cells ran before {config.script} or the version changed."
        )
    returned = dict.fromkeys(chain(["seconds"], *(record["result"] for record in done)))
    if absent := [column.key for column in experiment.columns if column.key not in returned]:
        notes.append(f"No cell returned {', '.join(absent)}; there are {', '.join(returned)}.")
    made_on = [f"{machine.in_words(r['machine'])}, gsjax {r['gsjax']}" for r in done]
    for where in dict.fromkeys(made_on):
        some = f" ({made_on.count(where)} of {len(done)} cells)" if len(set(made_on)) > 1 else ""
        notes.append(f"Machine: {where}{some}.")
    return notes
