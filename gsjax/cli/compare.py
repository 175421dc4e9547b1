"""`gsjax compare`: runs side by side, by what they came to and by what was asked of them."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.table import Table as Grid
from rich.text import Text

from gsjax.engine.compare.aspects import Aspect
from gsjax.engine.compare.comparison import Comparison, Group, compare
from gsjax.engine.compare.pictures import shows_the_same, write_strip
from gsjax.engine.folder import expect_ours, fresh_folder, is_run
from gsjax.engine.messages import counted
from gsjax.engine.options import Common
from gsjax.engine.records import read_record
from gsjax.engine.report import Media, Table, format_number, write_report
from gsjax.io.atomic import write_json
from gsjax.viz.plots import fit_curves, save

_ARROWS = {"more": " ↑", "less": " ↓", None: ""}
_PICTURES = 6  # held-out views of a group in the report
_JSON = "comparison.json"
_FOLDERS = {"plots": "curves_*.svg", "pictures": "*_[0-9][0-9][0-9][0-9].png"}  # and what is in them
_LOG_WIDTH = 200


@dataclass(frozen=True)
class Options(Common):
    """Options of `gsjax compare`."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN RUN [RUN ...]")]
    """Folders of runs of one command: `gsjax fit`, `track`, `parts`, `distill` or `deform`."""
    out: Path | None = None
    """Folder for comparison.json and report.html, with curves and pictures. It must be new, empty, or hold an
    earlier comparison, which is replaced. By default only the tables are printed."""


def run(options: Options) -> int:
    """Compare, print the tables and write the folder; returns the exit code.

    Raises:
        ValueError, OSError: a folder is none of a run, runs are of different commands, or the folder for the
            comparison holds something else.
    """
    if len(options.runs) < 2:
        raise ValueError(f"expected two runs or more to compare, found {len(options.runs)}")
    if options.out is not None:
        _check_folder(options.out)
    found = compare([read_record(path) for path in options.runs], shows_the_same)
    if options.out is not None:
        _write(options.out, found)
    _print(found, options.out)
    return 0


def _check_folder(out: Path) -> None:
    """Raises FileExistsError where the folder holds something that is no comparison."""
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"--out {out}: expected a folder, found a file; name another")
    if out.is_dir() and any(out.iterdir()) and (is_run(out) or not (out / _JSON).is_file()):
        what = "a run" if is_run(out) else "other files"
        raise FileExistsError(
            f"--out {out}: expected a new folder, an empty one or an earlier comparison, found {what}; "
            "name another"
        )
    for name, written in _FOLDERS.items():
        expect_ours(out / name, (written,))


def _write(out: Path, found: Comparison) -> None:
    """Writes report.html with its curves and pictures, and comparison.json."""
    out.mkdir(parents=True, exist_ok=True)
    plots, strips = [], []
    for name, written in _FOLDERS.items():
        fresh_folder(out / name, (written,))
    for i, group in enumerate(found.groups):
        of = f"{group.dataset}: " if len(found.groups) > 1 else ""
        if not group.views:
            continue
        curves = {label: found.records[label].curve for label in group.labels}
        judged = {n: c for n, c in curves.items() if any(row["test_psnr"] is not None for row in c)}
        if len(judged) > 1:
            plot = save(fit_curves(judged), out / "plots" / f"curves_{i}.svg")
            caption = (
                "PSNR of held-out views, of four at most while a fit goes on, over minutes with compiling"
            )
            plots.append(Media(plot, f"{of}{caption}"))
        members = {label: found.records[label] for label in group.labels}
        for view in group.views[:: max(1, -(-len(group.views) // _PICTURES))]:
            strip = out / "pictures" / f"{i}_{group.views.index(view):04d}.png"
            if write_strip(strip, members, view):
                strips.append(Media(strip, f"{of}{view}"))
    write_report(
        out / "report.html",
        title=f"Comparison of {len(found.records)} runs",
        subtitle="; ".join(_of_what(group) for group in found.groups),
        summary=_cards(found),
        tables=[*_score_tables(found), *_option_tables(found)],
        plots=plots,
        strips=strips,
        notes=found.notes,
    )
    write_json(out / _JSON, _as_json(found))


def _of_what(group: Group) -> str:
    """The group in words."""
    views = f", {counted(len(group.views), 'held-out view')}" if group.views else ""
    return f"{group.dataset}: {', '.join(group.labels)}{views}"


def _cards(found: Comparison) -> dict[str, Any]:
    """The best of each aspect, where all runs can be compared."""
    cards: dict[str, Any] = {}
    if len(found.groups) == 1:
        for aspect in found.aspects:
            best = found.groups[0].best.get(aspect.key)
            if best:
                value = format_number(found.scores[best[0]][aspect.key], aspect.decimals)
                cards[f"{aspect.head}: {', '.join(best)}"] = (value, aspect.unit)
    return cards


def _name(label: str, found: Comparison) -> str:
    return label if found.records[label].complete else f"{label} (partial)"


def _shown(found: Comparison, group: Group) -> list[Aspect]:
    """The columns in which something of a group stands."""
    return [a for a in found.aspects if any(found.scores[label][a.key] is not None for label in group.labels)]


def _score_tables(found: Comparison) -> Iterator[Table]:
    """One of each group; what is best stands out."""
    note = (
        "↑ more is better, ↓ less is better; the best of finished runs stands out where they can be compared."
    )
    for i, group in enumerate(found.groups):
        aspects = _shown(found, group)
        rows = [
            [_name(label, found), *(found.scores[label][a.key] for a in aspects)] for label in group.labels
        ]
        best = {
            (group.labels.index(label), 1 + column)
            for column, aspect in enumerate(aspects)
            for label in group.best.get(aspect.key, ())
        }
        yield Table(
            "Runs" if len(found.groups) == 1 else f"Runs of {group.dataset}",
            ("run", *(f"{a.head}{_ARROWS[a.better]}" for a in aspects)),
            rows,
            ("", *(a.unit for a in aspects)),
            note if i == len(found.groups) - 1 else "",
            (None, *(a.decimals for a in aspects)),
            best,
        )


def _option_tables(found: Comparison) -> Iterator[Table]:
    if found.options:
        rows = [[name, *map(_setting, values.values())] for name, values in found.options.items()]
        yield Table("Settings that differ", ("setting", *found.records), rows)


def _setting(value: Any) -> str:
    """As config.yml has it."""
    if value is None or isinstance(value, bool):
        return {None: "–", True: "true", False: "false"}[value]
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _as_json(found: Comparison) -> dict[str, Any]:
    """What comparison.json holds."""
    return {
        "kind": found.kind,
        "runs": [
            {"run": label, "path": str(record.path), "complete": record.complete} | found.scores[label]
            for label, record in found.records.items()
        ],
        "groups": [asdict(group) for group in found.groups],
        "better": {aspect.key: aspect.better for aspect in found.aspects},
        "units": {aspect.key: aspect.unit for aspect in found.aspects},
        "options": found.options,
        "notes": found.notes,
    }


def _print(found: Comparison, out: Path | None) -> None:
    """The tables of the report, for a terminal."""
    console = Console(highlight=False)
    if not console.is_terminal:  # a log has room, and programs search it
        console.width = _LOG_WIDTH
    for group in found.groups:
        console.print()
        if len(found.groups) > 1:
            console.print(Text(group.dataset, style="bold"))
        console.print(_score_grid(found, group))
    if found.options:
        grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
        for head in ("settings that differ", *found.records):
            grid.add_column(Text(head), overflow="fold")
        for name, values in found.options.items():
            grid.add_row(*(Text(cell) for cell in (name, *map(_setting, values.values()))))
        console.print()
        console.print(grid)
    console.print()
    for note in found.notes:
        console.print(Text(note, style="dim"), soft_wrap=not console.is_terminal)
    if out is not None:
        console.print(f"[bold]report[/]  {out / 'report.html'}", soft_wrap=True)


def _score_grid(found: Comparison, group: Group) -> Grid:
    """A row a run, with the columns in which something stands."""
    shown = _shown(found, group)
    grid = Grid(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    grid.add_column("run\n", no_wrap=True, min_width=max(len(_name(label, found)) for label in group.labels))
    for aspect in shown:
        head, unit = aspect.head.replace(" ", "\n", 1), f"{aspect.unit}{_ARROWS[aspect.better]}".strip()
        grid.add_column(f"{head}\n[dim]{unit}[/]", justify="right", no_wrap=True)
    for label in group.labels:
        cells = []
        for aspect in shown:
            text = format_number(found.scores[label][aspect.key], aspect.decimals)
            cells.append(Text(text, style="bold green" if label in group.best.get(aspect.key, ()) else ""))
        grid.add_row(Text(_name(label, found)), *cells)
    return grid
