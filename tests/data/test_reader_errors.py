"""Every reader and what may be wrong with its files: each message names the file and says what to do.

docs/data-errors.md is written from these messages: `python -m tests.data.test_reader_errors`.
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
HEAD = """# What readers say

What each reader says of data that is damaged or incomplete. `DATA` stands for the folder. *Refused* is an
error (`DataError`, or another `ValueError` or `OSError`; exit code 2 on the command line); *used without it*
is a `DataWarning`, and the rest is read; *used* is one too, and all is read as it is. Words of other
libraries and sizes of files are left out (`...`).
`python -m tests.data.test_reader_errors` writes this page, and a test compares it.
"""

# What others say of a file, and how many bytes an encoder wrote, differ from version to version.
_FOREIGN = re.compile(
    r"(bad JSON|bad data|something else|no text|one that cannot be parsed|cut off) \((?:[^()]|\([^()]*\))*\)"
)
_BYTES = re.compile(r"\d+ (bytes|items)")


class Said(NamedTuple):
    refused: bool
    text: str


@cache
def _sound(layout: str) -> Path:
    """A recording with which nothing is wrong, made once."""
    folder = Path(tempfile.mkdtemp()) / "freiburg3_DATA"  # TUM's reader takes its camera from the name
    folder.mkdir()
    LAYOUTS[layout].build(folder)
    return folder


def said_of(layout: str, fault: Fault, scratch: Path) -> Said:
    """What reading a recording with this fault says, paths replaced."""
    root = Path(shutil.copytree(_sound(layout), scratch / "freiburg3_DATA"))
    fault.damage(root)
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", DataWarning)
        try:
            LAYOUTS[layout].read(root)
        except (ValueError, OSError) as error:
            return Said(True, _plain(str(error), root))
    texts = [str(warning.message) for warning in heard if issubclass(warning.category, DataWarning)]
    return Said(False, _plain("; ".join(texts), root))


def _plain(text: str, root: Path) -> str:
    text = text.replace(str(root), "DATA").replace(root.name, "DATA")
    return _BYTES.sub(r"... \1", _FOREIGN.sub(r"\1 (...)", text))


def page(scratch: Path) -> str:
    """docs/data-errors.md."""
    parts = [HEAD]
    for number, (layout, fault) in enumerate(CASES):
        if LAYOUTS[layout].faults[0] is fault:
            parts.append(f"\n## {layout}\n\n| what is wrong | | what is said |\n| --- | --- | --- |\n")
        refused, text = said_of(layout, fault, scratch / str(number))
        used = "used without it" if "left out" in text else "used"
        outcome, escaped = "refused" if refused else used, text.replace("|", r"\|")
        parts.append(f"| {fault.what} | {outcome} | `{escaped}` |\n")
    return "".join(parts)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_there_is_nothing_to_say_of_sound_data(layout):
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        LAYOUTS[layout].read(_sound(layout))


@pytest.mark.parametrize(
    ("layout", "fault"), [pytest.param(*case, id=f"{case[0]}-{case[1].what}") for case in CASES]
)
def test_messages_name_the_file_and_say_what_to_do(layout, fault, tmp_path):
    refused, text = said_of(layout, fault, tmp_path)
    assert all(name in text for name in fault.names), text
    if refused:
        said, _, advice = text.rpartition("found ") if "found " in text else ("", "", text)
        assert re.search(r"[.!?] [A-Z][^.]*[a-z].*[.?]?$", advice), text
        assert not said or "expected " in said, text
    else:
        assert "left out" in text or re.search(r"[.;?] .*\b(give|set) ", text), text


def test_the_page_in_the_docs_is_what_readers_say(tmp_path):
    written = PAGE.read_text(encoding="utf-8")
    assert written == page(tmp_path), "run python -m tests.data.test_reader_errors"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(page(Path(folder)), encoding="utf-8")
