"""The outcome of a run or a film, as printed by `gsjax info`."""

import warnings
from pathlib import Path

from gsjax.engine.compare.data import SCORES, data_in_words, data_of
from gsjax.engine.folder import is_finished, is_resumable, read_values
from gsjax.engine.info_scene import describe_scene
from gsjax.engine.messages import counted, describe
from gsjax.engine.records import EVALUATION, Record, is_of_live, kind_of, read_record
from gsjax.engine.summary import cards_of
from gsjax.io.parsed import parse_json


def describe_run(path: Path) -> dict[str, str]:
    """Facts about a run: how it ended, its data, its scores, and its scene; problems become warnings.

    Raises:
        ValueError, OSError: its settings or scores cannot be read.
    """
    if kind_of(path) is None:
        facts = _facts_of_stream(path)
    else:
        record = read_record(path)
        facts = {"run": f"gsjax {record.kind}, {_ending(record)}"} | _scores(record)
        if record.metrics is not None and (notes := record.metrics.get("notes")):
            facts["notes"] = "\n".join(map(str, notes))
        for note in record.notes:
            warnings.warn(note, UserWarning, stacklevel=1)
        if record.evaluation is not None:
            facts["gsjax eval"] = str(path / EVALUATION)
    if (scene := path / "scene.ply").is_file():
        try:
            facts |= describe_scene(scene)
        except (ValueError, OSError) as error:
            warnings.warn(describe(error), UserWarning, stacklevel=1)
    if (report := path / "report.html").is_file():
        facts["report"] = str(report)
    return facts


def _facts_of_stream(path: Path) -> dict[str, str]:
    """Facts about a run of `gsjax live`: how well it kept up."""
    metrics = path / "metrics.json"
    if not is_of_live(path):
        return {"run": f"of a command whose scores are not listed here; they are in {metrics}"}
    found = read_values(metrics, parse_json)
    try:
        frames, latency = found["frames"], found["latency_ms"]
        lost = ", ".join(f"{name} in {counted(n, 'frame')}" for name, n in found["frames_lost"].items() if n)
        facts = {
            "run": "gsjax live, " + (f"stopped by {found['stopped']}" if found["stopped"] else "finished"),
            "source": str(found["source"]),
            "frames": f"{frames['used']:,} of {frames['offered']:,}, {found['hz'] or 0:.2f} Hz",
        }
        if latency is not None:
            facts["latency"] = f"median {latency['median']:.0f} ms, 95 % below {latency['p95']:.0f} ms"
        facts["lost"] = lost or "nothing"
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"{metrics}: expected the scores of gsjax live, found others ({describe(error)}); run it again "
            "with this version of gsjax"
        ) from error
    if notes := found.get("notes"):
        facts["notes"] = "\n".join(map(str, notes))
    if (trajectory := path / "trajectory.npz").is_file():
        facts["trajectory"] = str(trajectory)
    return facts


def describe_film(path: Path) -> dict[str, str]:
    """Facts about a film of `gsjax edit`: its run, its edits, and how long it is.

    Raises:
        ValueError, OSError: its edits or its numbers cannot be read.
    """
    from gsjax.engine.parts.films import VIDEO, read_edits_of  # slow to import

    edits = read_edits_of(path).edits
    found = read_values(path / "metrics.json", parse_json)
    whole = "" if found.get("complete", True) else ", stopped before its end"
    facts = {
        "film": f"gsjax edit {found['run']}{whole}",
        "edits": "; ".join(edit.operation() for edit in edits),
        "length": f"{found['seconds']:.2f} s, {counted(found['frames'], 'frame')}",
        "Gaussians": f"{found['num_gaussians']:,}",
        "video": str(path / VIDEO),
    }
    if notes := found.get("notes"):
        facts["notes"] = "\n".join(map(str, notes))
    return facts


def _ending(record: Record) -> str:
    """Whether a run ended, in words, and what to do if not."""
    if is_finished(record.path):
        return "finished"
    stopped = (record.metrics or {}).get("stopped")
    ending = f"stopped by {stopped}" if stopped else "still going on, or killed"
    return f"{ending}; " + ("continue it with --resume" if is_resumable(record.path) else "run it again")


def _scores(record: Record) -> dict[str, str]:
    """The data of a run, and its scores if it has any."""
    if record.metrics is None:
        return {"dataset": str(record.config.get("dataset") or record.config.get("scene"))}
    try:
        data = data_in_words(record.metrics["dataset"], data_of(record.kind, record.metrics))
        cards = cards_of(SCORES[record.kind], record.metrics)
        return {"dataset": data} | {card.head: f"{card.text} {card.unit}".strip() for card in cards}
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise ValueError(
            f"{record.path / 'metrics.json'}: expected the scores of gsjax {record.kind}, found others "
            f"({describe(error)}); run it again with this version of gsjax"
        ) from error
