"""The summary of a comparison: runs side by side, the settings that differ, curves and pictures."""

import shutil
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsjax.engine.compare.comparison import Comparison, Group
from gsjax.engine.compare.pictures import write_strip
from gsjax.engine.folder import expect_replaceable
from gsjax.engine.messages import counted
from gsjax.engine.summary import Card, Column, Media, Summary, Table
from gsjax.viz.plots import fit_curves, save

FOLDERS = {"plots": "curves_*.svg", "pictures": "*_[0-9][0-9][0-9][0-9].png"}
"""Folders of a comparison, and the files in them."""
_PICTURES = 6  # held-out views of a group in the report
_NOTE = "↑ more is better, ↓ less is better; the best of finished runs stands out where they can be compared."
_CURVES = "PSNR of at most four held-out views during the fit, over minutes with compiling"


def summarize(found: Comparison, out: Path | None) -> Summary:
    """The summary of a comparison.

    Args:
        found: the comparison.
        out: folder for its curves and pictures, which replace earlier ones; None: none are drawn.
    """
    plots, strips = ([], []) if out is None else _draw(found, out)
    return Summary(
        title=f"Comparison of {len(found.records)} runs",
        subtitle="; ".join(map(_describe, found.groups)),
        cards=_cards(found),
        tables=[*(_score_table(found, group) for group in found.groups), *_option_tables(found)],
        plots=plots,
        strips=strips,
        notes=found.notes,
    )


def as_json(found: Comparison) -> dict[str, Any]:
    """The contents of comparison.json."""
    return {
        "kind": found.kind,
        "runs": [
            {"run": label, "path": str(record.path), "complete": record.complete} | found.scores[label]
            for label, record in found.records.items()
        ],
        "groups": [asdict(group) for group in found.groups],
        "better": {score.key: score.better for score in found.shown},
        "units": {score.key: score.unit for score in found.shown},
        "options": found.options,
        "notes": found.notes,
    }


def _draw(found: Comparison, out: Path) -> tuple[list[Media], list[Media]]:
    """Write the curves and the pictures of held-out views that the runs of a group have in common."""
    plots, strips = [], []
    out.mkdir(parents=True, exist_ok=True)
    for name, written in FOLDERS.items():
        folder = expect_replaceable(out / name, (written,))
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir()
    for i, group in enumerate(found.groups):
        prefix = f"{group.dataset}: " if len(found.groups) > 1 else ""
        if not group.views:
            continue
        members = {label: found.records[label] for label in group.labels}
        curves = {label: record.curve for label, record in members.items()}
        judged = {n: c for n, c in curves.items() if any(row["test_psnr"] is not None for row in c)}
        if len(judged) > 1:
            plot = save(fit_curves(judged), out / "plots" / f"curves_{i}.svg")
            plots.append(Media(plot, f"{prefix}{_CURVES}"))
        for view in group.views[:: max(1, -(-len(group.views) // _PICTURES))]:
            strip = out / "pictures" / f"{i}_{group.views.index(view):04d}.png"
            if write_strip(strip, members, view):
                strips.append(Media(strip, f"{prefix}{view}"))
    return plots, strips


def _describe(group: Group) -> str:
    """Describes a group."""
    views = f", {counted(len(group.views), 'held-out view')}" if group.views else ""
    return f"{group.dataset}: {', '.join(group.labels)}{views}"


def _cards(found: Comparison) -> list[Card]:
    """The best runs by each score, if all runs can be compared."""
    if len(found.groups) > 1:
        return []
    best = found.groups[0].best
    return [
        Card(f"{s.head}: {', '.join(best[s.key])}", found.scores[best[s.key][0]][s.key], s.unit, s.decimals)
        for s in found.shown
        if best.get(s.key)
    ]


def _score_table(found: Comparison, group: Group) -> Table:
    """The runs of a group, a row each."""
    rows = [
        {"run": label if found.records[label].complete else f"{label} (partial)"} | found.scores[label]
        for label in group.labels
    ]
    best = {(group.labels.index(label), key) for key, labels in group.best.items() for label in labels}
    return Table(
        "Runs" if len(found.groups) == 1 else f"Runs of {group.dataset}",
        (Column("run", "run"), *(score.column for score in found.shown)),
        rows,
        _NOTE if group is found.groups[-1] else "",
        best=best,
        brief=True,
    )


def _option_tables(found: Comparison) -> Iterator[Table]:
    if found.options:
        columns = (Column("setting", "setting"), *(Column(label, label) for label in found.records))
        rows = [
            {"setting": name} | {label: _setting(value) for label, value in values.items()}
            for name, values in found.options.items()
        ]
        yield Table("Settings that differ", columns, rows, brief=True)


def _setting(value: Any) -> str:
    """A setting as it is written in config.yml."""
    if value is None or isinstance(value, bool):
        return {None: "–", True: "true", False: "false"}[value]
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
