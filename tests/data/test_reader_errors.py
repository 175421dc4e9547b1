"""Faults in the files of every reader: each message names the file and says what to do.

docs/data-errors.md is generated from these messages: `python -m tests.data.test_reader_errors`.
"""

import re
import shutil
import tempfile
import warnings
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from gsjax.data import DataWarning
from tests.data.faults_of_photographs import PHOTOGRAPHS
from tests.data.faults_of_recordings import RECORDINGS
from tests.data.faults_of_surgery import SURGERY
from tests.data.faulty import Fault

LAYOUTS = PHOTOGRAPHS | RECORDINGS | SURGERY
CASES = [(name, fault) for name, layout in LAYOUTS.items() for fault in layout.faults]
PAGE = Path(__file__).parents[2] / "docs" / "data-errors.md"
HEAD = """# Reader errors and warnings

The message of each reader for damaged or incomplete data. `DATA` stands for the folder. *Refused* means an
error (`DataError`, or another `ValueError` or `OSError`; exit code 2 on the command line); *used without it*
means a `DataWarning`, and the rest is read; *used* means a `DataWarning`, and everything is read as it is.
Messages of other libraries and file sizes are replaced by `...`.
`python -m tests.data.test_reader_errors` writes this page, and a test compares it.
"""

# Messages of other libraries, and file sizes of encoders, differ from version to version.
_FOREIGN = re.compile(
    r"(bad JSON|bad data|something else|binary data|one that cannot be parsed|cut off) "
    r"\((?:[^()]|\([^()]*\))*\)"
)
_BYTES = re.compile(r"\d+ (bytes|items)")


class Outcome(NamedTuple):
    refused: bool
    message: str


@cache
def _sound(layout: str) -> Path:
    """A recording without faults, made once."""
    folder = Path(tempfile.mkdtemp()) / "freiburg3_DATA"  # TUM's reader identifies the camera by the name
    folder.mkdir()
    LAYOUTS[layout].build(folder)
    return folder


def outcome_of(layout: str, fault: Fault, scratch: Path) -> Outcome:
    """The outcome of reading a recording with this fault, with paths replaced in the message."""
    root = Path(shutil.copytree(_sound(layout), scratch / "freiburg3_DATA"))
    fault.damage(root)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", DataWarning)
        try:
            LAYOUTS[layout].read(root)
        except (ValueError, OSError) as error:
            return Outcome(True, _plain(str(error), root))
    messages = [str(warning.message) for warning in caught if issubclass(warning.category, DataWarning)]
    return Outcome(False, _plain("; ".join(messages), root))


def _plain(text: str, root: Path) -> str:
    text = text.replace(str(root), "DATA").replace(root.name, "DATA")
    return _BYTES.sub(r"... \1", _FOREIGN.sub(r"\1 (...)", text))


def page(scratch: Path) -> str:
    """The contents of docs/data-errors.md."""
    parts = [HEAD]
    for number, (layout, fault) in enumerate(CASES):
        if LAYOUTS[layout].faults[0] is fault:
            parts.append(f"\n## {layout}\n\n| fault | outcome | message |\n| --- | --- | --- |\n")
        refused, message = outcome_of(layout, fault, scratch / str(number))
        used = "used without it" if "left out" in message else "used"
        outcome, escaped = "refused" if refused else used, message.replace("|", r"\|")
        parts.append(f"| {fault.what} | {outcome} | `{escaped}` |\n")
    return "".join(parts)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_sound_data_raises_no_warnings(layout):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        LAYOUTS[layout].read(_sound(layout))


@pytest.mark.parametrize(
    ("layout", "fault"), [pytest.param(*case, id=f"{case[0]}-{case[1].what}") for case in CASES]
)
def test_messages_name_the_file_and_say_what_to_do(layout, fault, tmp_path):
    refused, message = outcome_of(layout, fault, tmp_path)
    assert all(name in message for name in fault.names), message
    if refused:
        before, _, advice = message.rpartition("found ") if "found " in message else ("", "", message)
        assert re.search(r"[.!?] [A-Z][^.]*[a-z].*[.?]?$", advice), message
        assert not before or "expected " in before, message
    else:
        assert "left out" in message or re.search(r"[.;?] .*\b(give|set) ", message), message


def test_the_page_in_the_docs_is_up_to_date(tmp_path):
    written = PAGE.read_text(encoding="utf-8")
    assert written == page(tmp_path), "run python -m tests.data.test_reader_errors"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(page(Path(folder)), encoding="utf-8")
