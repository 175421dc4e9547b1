"""Records of cells: one file each in runs/, and the rows of results.json, which are committed."""

from pathlib import Path
from typing import Any

from gsjax.engine.experiments.config import expect
from gsjax.io.parsed import parse_json

RESULTS = "results.json"
RECORD = ("options", "seed", "script", "result", "error", "seconds", "finished", "machine", "gsjax")
"""Keys of a record; `script` is the fingerprint of the script, `finished` is UTC in ISO 8601. If all workers
of the cell died, `seconds` and `machine` are None."""
_ADVICE = "delete the file to do without it"


def read_record(path: Path) -> dict[str, Any]:
    """The record of a cell.

    Raises:
        ValueError: the file holds something else.
    """
    return _record(_json(path), path)


def committed_rows(path: Path) -> list[dict[str, Any]]:
    """The records in a results.json, which stores what all rows share only once; none if there is no such
    file.

    Raises:
        ValueError: the file holds something else.
    """
    found = _json(path) if path.is_file() else {"same": {}, "rows": []}
    try:
        return [_record({"error": None, **found["same"], **row}, path) for row in found["rows"]]
    except (TypeError, KeyError) as error:  # not a dict, or not of dicts
        raise ValueError(f"{path}: expected rows as gsjax writes them, found {error}; {_ADVICE}") from error


def _json(path: Path) -> Any:
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, found {error}; {_ADVICE}") from error


def _record(found: Any, path: Path) -> dict[str, Any]:
    """The record read from `path`; raises a ValueError if it is none."""
    lacks = [key for key in RECORD if key not in found] if isinstance(found, dict) else [*RECORD]
    expect(not lacks, f"{path}", "the record of a cell", f"none: no {', '.join(lacks)}; {_ADVICE}")
    return found
