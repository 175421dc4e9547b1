"""The comparison of several runs: the numbers behind `gsjax compare`."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsjax.engine.compare.data import MUST_SHARE, SCORES, data_in_words, data_of
from gsjax.engine.folder import flattened
from gsjax.engine.machine import name as machine_name
from gsjax.engine.records import Kind, Record
from gsjax.engine.summary import Score, format_number

_NOT_COMPARED = (
    "out",
    "resume",
    "overwrite",
    "debug",
    "tensorboard",
)  # settings that do not affect a result


_OF_VIEWS = [score.key for score in SCORES["fit"] if score.of == "views"]


@dataclass
class Group:
    """Runs of the same data, at the same size.

    Attributes:
        dataset: its name.
        labels: of the runs.
        views: held-out views by which all of them were judged; scores are means over these.
        best: the best runs by each score; a score that cannot be compared is missing.
    """

    dataset: str
    labels: list[str]
    views: list[str] = field(default_factory=list)
    best: dict[str, list[str]] = field(default_factory=dict)


@dataclass
class Comparison:
    """The result of a comparison.

    Attributes:
        kind: the command that made the runs.
        records: the runs, by their labels, group by group.
        scores: of each run, by the keys of `SCORES`; None if unknown.
        groups: runs that can be compared with each other.
        options: each run's values of the settings that all runs have but that differ between runs.
        notes: what was not compared, and why.
    """

    kind: Kind
    records: dict[str, Record]
    scores: dict[str, dict[str, float | None]]
    groups: list[Group]
    options: dict[str, dict[str, Any]]
    notes: list[str]

    @property
    def shown(self) -> list[Score]:
        """The scores that any run has."""
        return [a for a in SCORES[self.kind] if any(s[a.key] is not None for s in self.scores.values())]


def compare(records: Sequence[Record], same_views: Callable[[list[Record], str], bool]) -> Comparison:
    """Compare runs.

    Args:
        records: two or more runs.
        same_views: (runs, name of a held-out view) -> whether the view shows the same in all of them.

    Raises:
        ValueError: they are runs of different commands.
    """
    kinds = {record.kind: [str(r.path) for r in records if r.kind == record.kind] for record in records}
    if len(kinds) > 1:
        listed = " and ".join(f"`gsjax {kind}` ({', '.join(names)})" for kind, names in kinds.items())
        raise ValueError(
            f"expected runs of one command, found those of {listed}; compare each command's runs separately"
        )
    labelled = dict(zip(labels([record.path for record in records]), records, strict=True))
    kind, notes = records[0].kind, [note for record in records for note in record.notes]
    groups: dict[Any, Group] = {}
    for label, record in labelled.items():
        key = _data(record, records)
        groups.setdefault(key, Group(key[0], [])).labels.append(label)
    if len(groups) > 1:
        apart = "; ".join(f"{data_in_words(*key)}: {', '.join(g.labels)}" for key, g in groups.items())
        notes.append(f"Only runs of the same data are compared with each other: {apart}.")
    scores: dict[str, dict[str, float | None]] = {}
    for group in groups.values():
        members = {label: labelled[label] for label in group.labels}
        if kind == "fit":
            group.views = _common_views(members, same_views, notes)
            scores |= _fit_scores(members, group.views)
            comparable = _comparable_fits(members, group.views, notes)
        else:
            scores |= {label: _scores(record) for label, record in members.items()}
            comparable = {score.key for score in SCORES[kind]} - _incomparable(kind, members, scores, notes)
        if len(members) > 1 and len({_machine(record) for record in members.values()} - {None}) > 1:
            notes.append(f"{', '.join(members)}: run on different machines; time is not compared.")
            comparable -= {score.key for score in SCORES[kind] if score.of == "machine"}
        group.best = _best(kind, members, scores, comparable)
    for label, record in labelled.items():
        if not record.complete:
            words = "was stopped" if record.metrics else "is still going on, or was killed"
            notes.append(f"{label} {words}: it is shown, and not among the best.")
    if kind == "fit":
        notes += _missing_scores(labelled)
    ordered = {label: labelled[label] for group in groups.values() for label in group.labels}
    options = _differing(ordered, notes)
    return Comparison(kind, ordered, scores, list(groups.values()), options, notes)


def labels(paths: Sequence[Path]) -> list[str]:
    """A short label for each folder: as many of the last parts of its path as distinguish it from the others.

    Raises:
        ValueError: a folder is given twice.
    """
    parts = [path.resolve().parts for path in paths]
    for i, part in enumerate(parts):
        if part in parts[:i]:
            raise ValueError(f"{paths[i]}: named twice; name each run once")
    names = []
    for part in parts:
        count = next(
            n for n in range(1, len(part) + 1) if sum(other[-n:] == part[-n:] for other in parts) == 1
        )
        names.append("/".join(part[-count:]))
    return names


def _data(record: Record, records: Sequence[Record]) -> tuple[str, Any]:
    """What runs must share to be compared. An unfinished fit is taken to be of the same data as a finished
    one with the same options for the data."""
    found = record.metrics
    if found is None and record.kind == "fit":
        named = _words(record)
        same = next((r for r in records if r.metrics is not None and _words(r) == named), None)
        found = None if same is None else same.metrics
    if found is None:
        return Path(str(record.config.get("dataset"))).name, None
    return found["dataset"], data_of(record.kind, found)


def _words(record: Record) -> tuple[Any, ...]:
    return tuple(str(record.config.get(name)) for name in ("dataset", "scale", "read"))


def _held_out(record: Record) -> dict[str, dict[str, Any]]:
    """The scores of each held-out view of a fit, by the view's name, with those of `gsjax eval` if it was
    evaluated."""
    found = record.metrics
    if found is None or not found["photographs"]["held_out"]:
        return {}
    rows = {row["view"]: dict(row) for row in found["views"]}
    for row in (record.evaluation or {}).get("views", ()):
        if row["split"] == "held out" and row["view"] in rows:
            rows[row["view"]] |= {key: row[key] for key in ("ms_ssim", "lpips")}
    return rows


def _common_views(
    members: Mapping[str, Record], same: Callable[[list[Record], str], bool], notes: list[str]
) -> list[str]:
    """Held-out views that all runs with scores share; none if there is nothing to compare."""
    judged = {label: _held_out(record) for label, record in members.items()}
    judged = {label: rows for label, rows in judged.items() if rows}
    if len(judged) < 2:
        return []
    of, first = ", ".join(judged), next(iter(judged.values()))
    views = [view for view in first if all(view in rows for rows in judged.values())]
    if not views:
        notes.append(
            f"{of}: no held-out view in common; their scores are of different views and not compared."
        )
        return []
    if any(len(rows) > len(views) for rows in judged.values()):
        notes.append(
            f"{of}: different views were held out; scores are means over the {len(views)} in common."
        )
    runs = [members[label] for label in judged]
    shown = views[:: max(1, len(views) // 4)]
    if other := [view for view in shown if not same(runs, view)]:
        notes.append(f"{of}: {', '.join(other)} show different photographs in them; scores are not compared.")
        return []
    return views


def _fit_scores(members: Mapping[str, Record], views: list[str]) -> dict[str, dict[str, float | None]]:
    """The scores of each fit; scores of views are means over the common views if there are any, else over its
    own."""
    judged = {label: _held_out(record) for label, record in members.items()}
    scores: dict[str, dict[str, float | None]] = {}
    for label, record in members.items():
        scores[label] = _scores(record)
        if record.metrics is None and record.curve:  # not scored yet
            last = record.curve[-1]
            scores[label] |= {"num_gaussians": last["alive"], "steps": last["step"]}
            scores[label] |= {"minutes": last["seconds"] / 60}
    for key in _OF_VIEWS:
        known = {
            label: {v for v, row in rows.items() if _is_known(row.get(key))} for label, rows in judged.items()
        }
        having = [known[label] for label in members if known[label]]
        common = set(views).intersection(*having) if having else set()
        for label, rows in judged.items():
            over = (common if views else known[label]) & known[label]
            values = [rows[view][key] for view in rows if view in over]
            scores[label][key] = float(np.mean(values)) if values else None
    return scores


def _is_known(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _comparable_fits(members: Mapping[str, Record], views: list[str], notes: list[str]) -> set[str]:
    """Keys of the scores by which these fits can be compared."""
    keys = {score.key for score in SCORES["fit"] if views or score.of != "views"}
    weights = {
        label: (record.evaluation or {}).get("lpips", {}).get("weights") for label, record in members.items()
    }
    if len({*weights.values()} - {None}) > 1:
        notes.append(f"{', '.join(members)}: LPIPS is of different weights and not compared.")
        keys -= {"lpips"}
    return keys


def _incomparable(
    kind: Kind, members: Mapping[str, Record], scores: Mapping[str, Mapping[str, Any]], notes: list[str]
) -> set[str]:
    """Keys of the scores that these runs cannot be compared by, because their settings differ."""
    apart: set[str] = set()
    for names, keys in MUST_SHARE.get(kind, {}).items():
        judged = [label for label in members if any(scores[label][key] is not None for key in keys)]
        settings = [_resolved(members[label]) for label in judged]
        # Other versions lack some settings, which `_differing` notes.
        values = {n: {repr(one[n]) for one in settings if n in one} for n in names}
        if differing := [n for n in names if len(values[n]) > 1]:
            options = ", ".join(f"--{name.replace('_', '-')}" for name in differing)
            known = [
                s for s in SCORES[kind] if s.key in keys and any(scores[n][s.key] is not None for n in judged)
            ]
            heads = ", ".join(score.head for score in known)
            notes.append(f"{', '.join(judged)} differ in {options}, so they are not compared by {heads}.")
            apart |= {*keys}
    return apart


def _resolved(record: Record) -> dict[str, Any]:
    """The settings of a run by their options; where the data decided, what was used."""
    settings, found = flattened(record.config), record.metrics or {}
    settings |= {name: found[name] for name in ("masks", "tools") if name in found}
    if settings.get("features") == "auto":
        settings["features"] = found.get("features")
    if "depth" in found:
        settings["depth"] = found["depth"]["source"]
    return settings


def _missing_scores(records: Mapping[str, Record]) -> list[str]:
    """Notes on the fits without MS-SSIM or LPIPS, and on how to get them."""
    judged = [label for label, record in records.items() if _held_out(record)]
    found = {label: records[label].evaluation or {} for label in judged}
    never = [n for n in judged if all(row["split"] != "held out" for row in found[n].get("views", ()))]
    blind = [n for n in judged if n not in never and "absent" in found[n]["lpips"]]
    notes = []
    if never:
        words = "gsjax eval RUN adds them (LPIPS with --lpips-weights PATH; see docs/scores.md)"
        notes.append(f"MS-SSIM and LPIPS are absent for {', '.join(never)}: {words}.")
    if blind:
        words = "gsjax eval RUN --lpips-weights PATH adds it (docs/scores.md)"
        notes.append(f"LPIPS is absent for {', '.join(blind)}, evaluated without weights: {words}.")
    return notes


def _scores(record: Record) -> dict[str, float | None]:
    """The scores of a run, from its metrics."""
    found = record.metrics
    return {a.key: None if found is None else a.value(found) for a in SCORES[record.kind]}


def _machine(record: Record) -> str | None:
    return None if record.metrics is None else machine_name(record.metrics["machine"])


def _best(
    kind: Kind, members: Mapping[str, Record], scores: Mapping[str, Mapping[str, Any]], comparable: set[str]
) -> dict[str, list[str]]:
    """The best finished runs by each score, compared at the digits shown; a score is left out if all tie."""
    best = {}
    for score in SCORES[kind]:
        if score.better is None or score.key not in comparable:
            continue
        values = {label: scores[label][score.key] for label, record in members.items() if record.complete}
        values = {label: value for label, value in values.items() if value is not None}
        texts = {label: format_number(value, score.decimals) for label, value in values.items()}
        if len({*texts.values()}) > 1:
            pick = max if score.better == "more" else min
            winner = pick(values, key=lambda label: values[label])
            best[score.key] = [label for label, text in texts.items() if text == texts[winner]]
    return best


def _differing(records: Mapping[str, Record], notes: list[str]) -> dict[str, dict[str, Any]]:
    """Settings that all runs have but whose values differ. Notes settings that some runs lack."""
    flat = {label: flattened(record.config) for label, record in records.items()}
    names = [n for n in dict.fromkeys(n for s in flat.values() for n in s) if n not in _NOT_COMPARED]
    lacking: dict[tuple[str, ...], list[str]] = {}
    for label, settings in flat.items():
        lacking.setdefault(tuple(name for name in names if name not in settings), []).append(label)
    notes += [
        f"Another version of gsjax made {', '.join(labels)}: no setting {', '.join(missing)} there."
        for missing, labels in lacking.items()
        if missing
    ]
    shared = [name for name in names if all(name in settings for settings in flat.values())]
    found = {name: {label: settings[name] for label, settings in flat.items()} for name in shared}
    return {name: values for name, values in found.items() if len({*map(repr, values.values())}) > 1}
