"""Collecting the records of an experiment into results.json, .md, .html and the figure."""

import sys
from collections.abc import Callable
from typing import Any

from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from gsjax.engine.experiments.records import RESULTS
from gsjax.engine.experiments.sweep import Experiment
from gsjax.engine.experiments.table import Shown, remarks, tabulate
from gsjax.engine.messages import describe
from gsjax.engine.report import write_report
from gsjax.engine.streams import say_error
from gsjax.engine.summary import Column, Media, Summary, Table
from gsjax.io.atomic import atomic_write, write_json

SHARED = ("script", "machine", "gsjax")
"""Keys of a record that results.json holds once if all rows agree."""
DIGITS = 6
"""Digits of collected figures: enough for any table, few enough that noise makes no git diff."""


def collect(experiment: Experiment, figure: Callable | None, debug: bool) -> int:
    """Write results.json, .md, .html and the figure into the experiment's folder, and print the table.

    Args:
        experiment: the experiment.
        figure: `figure(rows, path)` of the script, or None.
        debug: whether its exceptions are passed on.

    Returns:
        1 if there is nothing to collect or `figure` failed, else 0.
    """
    records = [_rounded(record) for record in experiment.records()]
    done = [record for record in records if record["error"] is None]
    # A line of the table must not average over two versions of the script.
    present = [record["options"] for record in done if experiment.is_done(record)]
    done = [r for r in done if experiment.is_done(r) or r["options"] not in present]
    if not done:
        say_error(f"{experiment.name} has no cell that is done: nothing to collect")
        return 1
    rows = [{**r["options"], "seed": r["seed"], **r["result"], "seconds": r["seconds"]} for r in done]
    _write_json(experiment, records, done)
    shown, notes, drawing, failed = tabulate(experiment, rows), remarks(experiment, records, done), [], ""
    if figure is not None:
        try:
            with atomic_write(experiment.folder / experiment.figure.file) as temporary:
                figure(rows, temporary)
                if not temporary.exists():
                    raise FileNotFoundError("it wrote nothing to the path that it was given")
            drawing = [Media(experiment.folder / experiment.figure.file, experiment.figure.caption)]
        except (Exception, SystemExit) as error:
            if debug:
                raise
            failed = f"figure(rows, path) failed with {type(error).__name__}: {describe(error)}"
            notes.append(f"There is no figure: {failed}")
    _write_markdown(experiment, shown, notes, drawing)
    _write_page(experiment, shown, notes, drawing)
    grid = Grid(box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for head, right in zip(shown.heads, shown.numeric, strict=True):
        grid.add_column(Text(head), justify="right" if right else "left")
    for line in shown.lines:
        grid.add_row(*map(Text, line))
    console = stdout()
    console.print(grid, *(Text(note, "dim") for note in notes), sep="\n")
    page = str(experiment.folder / "results.html")
    console.print(Text.assemble(("results", "bold"), "  ", page), soft_wrap=True)
    if failed:
        say_error(f"{experiment.script}: {failed}")
    return 1 if failed else 0


def _rounded(record: dict[str, Any]) -> dict[str, Any]:
    """The record with rounded figures; options stay exact, because they identify the cell."""

    def few(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: few(item) for key, item in value.items()}
        if isinstance(value, list):
            return [few(item) for item in value]
        return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value

    return {**record, "result": few(record["result"]), "seconds": few(record["seconds"])}


def _write_json(experiment: Experiment, records: list[dict[str, Any]], done: list[dict[str, Any]]) -> None:
    """Write results.json, which `Experiment.committed` reads."""
    same = {key: done[0][key] for key in SHARED if all(record[key] == done[0][key] for record in done)}
    keys = ("options", "seed", "result", "seconds", "finished", *(key for key in SHARED if key not in same))
    found = {
        "experiment": experiment.name,
        "claim": experiment.config.claim.strip(),
        "source": experiment.config.source.strip(),
        "cells": len(experiment.cells),
        "same": same,
        "rows": [{key: record[key] for key in keys} for record in done],
        "failed": [
            {k: r[k] for k in ("options", "seed", "error")} for r in records if r["error"] is not None
        ],
    }
    write_json(experiment.folder / RESULTS, found)


def _write_markdown(experiment: Experiment, shown: Shown, notes: list[str], drawing: list[Media]) -> None:
    """Write results.md."""
    config, line = experiment.config, lambda cells: f"| {' | '.join(map(_escaped, cells))} |"
    rules = line("---:" if right else "---" for right in shown.numeric)
    text = [f"# {experiment.name}", "", _escaped(config.claim), "", f"Source: {_escaped(config.source)}", ""]
    text += [line(shown.heads), rules, *map(line, shown.lines), ""]
    text += [f"![{_escaped(media.caption)}]({media.path.name})\n" for media in drawing]
    text += [f"- {_escaped(note)}" for note in notes]
    with atomic_write(experiment.folder / "results.md") as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8")


def _escaped(text: str) -> str:
    """Text in one line, with bars escaped for Markdown tables."""
    return " ".join(text.split()).replace("|", "\\|")


def _write_page(experiment: Experiment, shown: Shown, notes: list[str], drawing: list[Media]) -> None:
    """Write results.html."""
    config = experiment.config
    pairs = zip(zip(*shown.lines, strict=True), shown.numeric, strict=True)
    columns = [_aligned(column) if numeric else column for column, numeric in pairs]
    heads = [Column(head, str(i)) for i, head in enumerate(shown.heads)]
    rows = [{str(i): text for i, text in enumerate(line)} for line in zip(*columns, strict=True)]
    summary = Summary(
        title=experiment.name,
        subtitle=f"{config.claim.strip()} Source: {config.source.strip()}",
        tables=[Table("Results", heads, rows)],
        plots=drawing,
        notes=notes,
    )
    write_report(experiment.folder / "results.html", summary)


def _aligned(column: tuple[str, ...]) -> list[str]:
    """Numbers with aligned decimal points, even where a page aligns them to the left."""
    lengths = [len(text.partition(" ")[0]) for text in column]
    spaces = ("\u2007" * (max(lengths) - length) for length in lengths)  # each as wide as a digit
    return [space + text for space, text in zip(spaces, column, strict=True)]


def stdout() -> Console:
    """A console on stdout that wraps lines only in a terminal."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else 1000)
