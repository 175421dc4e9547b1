"""`gsjax experiment`: sweeps that support a claim, resumed where they stopped, and collected into tables."""

import contextlib
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain, compress
from pathlib import Path
from statistics import fmean, stdev
from typing import Annotated, Any, NamedTuple

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table as Grid
from rich.text import Text

from gsjax.cli import machine
from gsjax.cli.experiment_sweep import (
    RESULTS,
    Cell,
    Column,
    Experiment,
    experiment_names,
    in_words,
    read_experiment,
    run_cell,
)
from gsjax.cli.messages import Notes, describe, say_error
from gsjax.cli.run.report import Media, format_number, write_report
from gsjax.cli.run.report import Table as PageTable
from gsjax.io.atomic import atomic_write, write_json

ARROWS = {"lower": " ↓", "higher": " ↑", "": ""}
SHARED = ("script", "machine", "gsjax")
"""Of a record: said once in results.json where all rows have the same."""
DIGITS = 6
"""Of collected figures: enough for any table, few enough that noise in the last ones makes no git diff."""


@dataclass(frozen=True, kw_only=True)
class List:
    """Say what experiments there are, and how far each is."""

    root: Path = Path("experiments")
    """Folder of the experiments: NAME/config.yaml, and beside it what is collected."""
    out: Path = Path("runs/experiments")
    """Folder for what each cell gives: NAME/ID.json."""
    debug: bool = False
    """Show Python's traceback when something fails; a run stops at the first cell that does."""


@dataclass(frozen=True, kw_only=True)
class Table(List):
    """Collect what is done into tables, running no cell."""

    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")]
    """The experiment's folder below the root."""


@dataclass(frozen=True, kw_only=True)
class Run(Table):
    """Run the cells of an experiment that are not done, and collect."""

    seeds: Annotated[tuple[int, ...], tyro.conf.arg(metavar="SEED [SEED ...]")] = ()
    """Only these of the config's seeds."""
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE [KEY=VALUE ...]")] = ()
    """Only cells whose options have these values; several values of one key are alternatives."""
    fresh: bool = False
    """Run cells again that are done."""


Options = List | Run | Table


def run(options: List | Run | Table) -> int:
    """List, run or collect; returns the exit code: 1 if a cell or the figure failed, 130 after Ctrl-C.

    Raises:
        ValueError, OSError: what was asked cannot be done; every cell that finished before is on disk.
    """
    if not isinstance(options, Table):
        return list_experiments(options)
    experiment = read_experiment(options.root, options.name, options.out)
    if isinstance(options, Run):
        return run_experiment(experiment, options)
    return collect(experiment, experiment.load()[1], options.debug)


def list_experiments(options: List) -> int:
    """Print one line for each experiment. A broken one is said and does not hide the others."""
    names, broken = experiment_names(options.root), False
    grid = Grid("name", "claim", "done", "", "when (UTC)", box=None, pad_edge=False, padding=(0, 3, 0, 0))
    for name in names:
        try:
            experiment = read_experiment(options.root, name, options.out)
            records = experiment.records()
        except (ValueError, OSError) as error:
            broken = True
            say_error(describe(error))
            continue
        done = f"{sum(map(experiment.is_done, records))} of {len(experiment.cells)}"
        failed = sum(record["error"] is not None for record in records)
        stale = sum(r["error"] is None and r["script"] != experiment.fingerprint for r in records)
        counts = ", ".join(f"{n} {word}" for n, word in ((failed, "failed"), (stale, "stale")) if n)
        when = max((r["finished"][:16].replace("T", " ") for r in records), default="–")
        grid.add_row(*map(Text, (name, experiment.config.claim.strip(), done, counts, when)))
    _stdout().print(grid if names else f"{options.root} has no NAME/config.yaml")
    return 2 if broken else 0


def run_experiment(experiment: Experiment, options: Run) -> int:
    """Run what is chosen and not done, in order, then collect. Ctrl-C keeps what is done."""
    console = Console(stderr=True, highlight=False)
    chosen = choose(experiment, options.seeds, options.only)
    script_run, figure = experiment.load()
    experiment.committed()  # if it cannot be read, that is said now and not after hours
    if options.fresh:  # forgotten at once, so that after Ctrl-C the rest goes on without --fresh
        for cell in chosen:
            experiment.path(cell).unlink(missing_ok=True)
    left = [cell for cell in chosen if not experiment.is_done(experiment.own(cell))]
    if len(left) < len(chosen):
        console.print(f"{len(chosen) - len(left)} of {len(chosen)} cells are done; --fresh runs them again")
    words = TextColumn("{task.description}", markup=False)
    columns = (words, BarColumn(bar_width=None), MofNCompleteColumn(), TimeRemainingColumn())
    failed = []
    try:
        with Notes(console), Progress(*columns, console=console, expand=True) as progress:
            task = progress.add_task("cells", total=len(chosen), completed=len(chosen) - len(left))
            for cell in left:
                progress.update(task, description=str(cell))
                record = run_cell(experiment, cell, script_run, options.debug)
                word, said = ("done  ", "green"), f"  {cell}  {record['seconds']:.1f} s"
                if record["error"]:
                    failed.append(cell)
                    word, said = ("failed", "bold red"), f"  {cell}  {record['error']}"
                console.print(Text.assemble(word, said), soft_wrap=not console.is_terminal)
                progress.update(task, advance=1, description="cells")
        code = collect(experiment, figure, options.debug)
    except KeyboardInterrupt:
        kept = sum(experiment.is_done(experiment.own(cell)) for cell in chosen)
        again = "the same command" + (" without --fresh" if options.fresh else "")
        after = f"by Ctrl-C after {kept} of {len(chosen)} cells"
        say_error(f"{after}; {again} goes on from there", word="stopped")
        return 130
    if failed:
        again = f"{len(failed)} of {len(chosen)} cells failed and will run again next time"
        say_error(f"{again}; the first one's traceback is in {experiment.path(failed[0])}")
        return 1
    return code


def _stdout() -> Console:
    """A console that wraps lines for people only."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else 1000)


def choose(experiment: Experiment, seeds: tuple[int, ...], only: tuple[str, ...]) -> list[Cell]:
    """The cells that `--seeds` and `--only` ask for, in order.

    Raises:
        ValueError: no cell has a key, or a value of it, or all of them together.
    """
    wanted: dict[str, set[str]] = {"seed": {str(seed) for seed in seeds}} if seeds else {}
    for text in only:
        key, sign, value = text.partition("=")
        if not sign:
            raise ValueError(f"--only: expected KEY=VALUE, found {text!r}")
        with contextlib.suppress(ValueError):  # 1e-3 and 0.001 are one
            value = in_words(json.loads(value))
        wanted.setdefault(key, set()).add(value)
    words = [cell.words for cell in experiment.cells]
    for key, values in wanted.items():
        known = dict.fromkeys(w[key] for w in words if key in w)
        if not known:
            keys = ", ".join(dict.fromkeys(chain(*words)))
            raise ValueError(f"--only: {experiment.name} has no option {key!r}; it has {keys}")
        if missing := values - set(known):
            found = ", ".join(sorted(missing))
            raise ValueError(f"{experiment.name}: no cell has {key}={found}; it is one of {', '.join(known)}")
    fits = [all(w.get(key) in values for key, values in wanted.items()) for w in words]
    if not any(fits):
        raise ValueError(f"{experiment.name}: no cell has all of {' '.join(only)}")
    return list(compress(experiment.cells, fits))


def collect(experiment: Experiment, figure: Callable | None, debug: bool) -> int:
    """Write results.json, .md, .html and the figure into the experiment's folder, and print the table.

    Args:
        figure: `figure(rows, path)` of the script, or None.
        debug: let through what it raises.

    Returns:
        1 if there is nothing to collect or `figure` failed, else 0.
    """
    records = [_rounded(record) for record in experiment.records()]
    done = [record for record in records if record["error"] is None]
    # One line of the table does not average over two versions of the script.
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
    console = _stdout()
    console.print(grid, *(Text(note, "dim") for note in notes), sep="\n")
    console.print(f"[bold]results[/]  {experiment.folder / 'results.html'}", soft_wrap=True)
    if failed:
        say_error(f"{experiment.script}: {failed}")
    return 1 if failed else 0


def _rounded(record: dict[str, Any]) -> dict[str, Any]:
    """The record with figures of few digits; options stay, for the cell is known by them."""

    def few(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: few(item) for key, item in value.items()}
        if isinstance(value, list):
            return [few(item) for item in value]
        return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value

    return {**record, "result": few(record["result"]), "seconds": few(record["seconds"])}


def _write_json(experiment: Experiment, records: list[dict[str, Any]], done: list[dict[str, Any]]) -> None:
    """Writes results.json, from which `Experiment.committed` reads the rows again."""
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


class Shown(NamedTuple):
    """The table, as text."""

    heads: list[str]
    lines: list[list[str]]
    numeric: list[bool]  # which columns hold numbers


def tabulate(experiment: Experiment, rows: list[dict[str, Any]]) -> Shown:
    """A line for each combination of options, in the order of the sweep."""
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
    """Those of the config, else one for each figure that is not a list."""
    known = {key for cell in experiment.cells for key in cell.words} | {"seconds"}
    plain = (key for row in rows for key, value in row.items() if not isinstance(value, (list, dict)))
    return experiment.columns or tuple(Column(key) for key in dict.fromkeys(plain) if key not in known)


def figures(column: Column, values: list[Any], num_seeds: int) -> str:
    """One cell of the table: a figure, or mean ± standard deviation of those there are over the seeds."""
    numbers = [value for value in values if isinstance(value, (int, float))]
    if not numbers:
        return " / ".join(dict.fromkeys(in_words(value) for value in values if value is not None)) or "–"
    form = (lambda value: format(value, column.format)) if column.format else format_number
    text = form(numbers[0]) if len(numbers) == 1 else f"{form(fmean(numbers))} ± {form(stdev(numbers))}"
    return text if len(numbers) == num_seeds else f"{text} ({len(numbers)}/{num_seeds})"


def remarks(experiment: Experiment, records: list[dict[str, Any]], done: list[dict[str, Any]]) -> list[str]:
    """What a reader must know beside the table, one sentence each."""
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


def _write_markdown(experiment: Experiment, shown: Shown, notes: list[str], drawing: list[Media]) -> None:
    """Writes results.md."""
    config, line = experiment.config, lambda cells: f"| {' | '.join(map(_escaped, cells))} |"
    rules = line("---:" if right else "---" for right in shown.numeric)
    text = [f"# {experiment.name}", "", _escaped(config.claim), "", f"Source: {_escaped(config.source)}", ""]
    text += [line(shown.heads), rules, *map(line, shown.lines), ""]
    text += [f"![{_escaped(media.caption)}]({media.path.name})\n" for media in drawing]
    text += [f"- {_escaped(note)}" for note in notes]
    with atomic_write(experiment.folder / "results.md") as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8")


def _escaped(text: str) -> str:
    """On one line, and without what would end a cell of a Markdown table."""
    return " ".join(text.split()).replace("|", "\\|")


def _write_page(experiment: Experiment, shown: Shown, notes: list[str], drawing: list[Media]) -> None:
    """Writes results.html."""
    config = experiment.config
    pairs = zip(zip(*shown.lines, strict=True), shown.numeric, strict=True)
    columns = [_aligned(column) if numeric else column for column, numeric in pairs]
    write_report(
        experiment.folder / "results.html",
        title=experiment.name,
        subtitle=f"{config.claim.strip()} Source: {config.source.strip()}",
        summary={},
        plots=drawing,
        tables=[PageTable("Results", shown.heads, list(zip(*columns, strict=True)))],
        notes=notes,
    )


def _aligned(column: tuple[str, ...]) -> list[str]:
    """Numbers with their points in one line, also where a page starts them at the left"""
    lengths = [len(text.partition(" ")[0]) for text in column]
    spaces = ("\u2007" * (max(lengths) - length) for length in lengths)  # each as wide as a digit
    return [space + text for space, text in zip(spaces, column, strict=True)]
