"""What a run came to, as `gsjax info` prints it."""

from pathlib import Path

from gsjax.engine.compare.data import SCORES, data_in_words, data_of
from gsjax.engine.info_scene import describe_scene
from gsjax.engine.records import Record, read_record
from gsjax.engine.summary import cards_of


def describe_run(path: Path) -> dict[str, str]:
    """Facts about a run: how it ended, its data, its scores, and its scene.

    Raises:
        ValueError, OSError: a file of it cannot be read, or it is of a command that keeps no scores.
    """
    record = read_record(path)
    facts = {"run": f"gsjax {record.kind}, {_ending(record)}", "dataset": str(record.config["dataset"])}
    if record.metrics is not None:
        facts["dataset"] = data_in_words(facts["dataset"], data_of(record.kind, record.metrics))
        cards = cards_of(SCORES[record.kind], record.metrics)
        facts |= {card.head: f"{card.text} {card.unit}".strip() for card in cards}
    if (scene := path / "scene.ply").is_file():
        facts |= describe_scene(scene)
    if (report := path / "report.html").is_file():
        facts["report"] = str(report)
    return facts


def _ending(record: Record) -> str:
    """Whether a run ended, in words."""
    if record.complete:
        return "finished"
    if record.metrics is None:
        return "still going on, or killed; if so, continue it with --resume"
    return f"stopped by {record.metrics.get('stopped') or 'something'}; continue it with --resume"
