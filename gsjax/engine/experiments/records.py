"""What is kept of the cells: a file each in runs/, and the rows of results.json, which are committed."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from gsjax.engine.experiments.config import expect

RESULTS = "results.json"
RECORD = ("options", "seed", "script", "result", "error", "seconds", "finished", "machine", "gsjax")
"""What the record of a cell holds; `script` is the fingerprint of what made it, `finished` is UTC, ISO 8601.
Where no worker lived to tell, `seconds` and `machine` are None."""
_ADVICE = "delete the file to do without it"


def now() -> str:
    """When something finished, as records say it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def read_record(path: Path) -> dict[str, Any]:
    """The record of a cell.

    Raises:
        ValueError: the file holds something else.
    """
    return _record(_json(path), path)


def committed_rows(path: Path) -> list[dict[str, Any]]:
    """The records in a results.json, in which what is the same in all rows stands above them; none where
    there is no such file.

    Raises:
        ValueError: the file holds something else.
    """
    found = _json(path) if path.is_file() else {"same": {}, "rows": []}
    try:
        return [_record({"error": None, **found["same"], **row}, path) for row in found["rows"]]
    except (TypeError, KeyError) as error:  # no dict, or not of dicts
        raise ValueError(f"{path}: expected rows as gsjax writes them, found {error}; {_ADVICE}") from error


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, found {error}; {_ADVICE}") from error


def _record(found: Any, path: Path) -> dict[str, Any]:
    """What was read from `path`, if it is a record."""
    lacks = [key for key in RECORD if key not in found] if isinstance(found, dict) else [*RECORD]
    expect(not lacks, f"{path}", "the record of a cell", f"none: no {', '.join(lacks)}; {_ADVICE}")
    return found
