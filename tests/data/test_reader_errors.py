"""Faults in the files of every reader: each message names the file and says what to do.

`python -m tests.data.test_reader_errors` writes docs/data-errors.md, the faults that readers find, and
reader_errors.md beside this file, which has their messages.
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
MESSAGES = Path(__file__).with_name("reader_errors.md")
PAGE_HEAD = """# Reader errors

Damage that each reader finds. Data that cannot be used raise `DataError`, or another `ValueError` or
`OSError` (exit code 2 on the command line); data that can be used in part, or with a doubt, give a
`DataWarning`. Each message names the file, what was expected, what was found, and what to do.
`python -m tests.data.test_reader_errors` writes this page.

layout | error | warning, the rest is used | warning, all is used
--- | --- | --- | ---
"""
HEAD = """# Messages of readers

Messages for damaged or incomplete data, as readers word them. `DATA` is the folder, `FILE` the path of the
file at fault, `...` a size or another library's words. Messages that differ only in names and numbers are
listed once.

*Rest used* and *all used* mark warnings (`DataWarning`). `python -m tests.data.test_reader_errors` writes
this file; a test compares it.
"""
SHARED = "Several layouts"
NEEDS = {"Record3D": "OpenEXR", "RealSense": "rosbags"}  # packages of extras

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


class Case(NamedTuple):
    layout: str
    what: str
    text: str


def found_in(scratch: Path) -> list[tuple[str, Case]]:
    """Each fault with its outcome: "" where the data are refused, else how much of them is used."""
    found = []
    for number, (layout, fault) in enumerate(CASES):
        refused, text = outcome_of(layout, fault, scratch / str(number))
        found.append((_USED[refused, "left out" in text], Case(layout, fault.what, text)))
    return found


_USED = {(True, True): "", (True, False): "", (False, True): "rest used", (False, False): "all used"}

_COLUMNS = ("", "rest used", "all used")


def page(found: list[tuple[str, Case]]) -> str:
    """docs/data-errors.md: the faults of each layout."""
    rows = []
    for layout in LAYOUTS:
        mine = [(used, case.what) for used, case in found if case.layout == layout]
        cells = ("; ".join(what for used, what in mine if used == column) for column in _COLUMNS)
        rows.append(" | ".join((layout, *cells)).rstrip() + "\n")
    return PAGE_HEAD + "".join(rows)


def messages(found: list[tuple[str, Case]]) -> str:
    """reader_errors.md: a table of the messages that several layouts share, then one for each layout."""
    alike: dict[tuple[str, str], list[Case]] = {}
    for used, case in found:
        alike.setdefault((used, _pattern(case.text)), []).append(case)
    sections: dict[str, list[str]] = {name: [] for name in (SHARED, *LAYOUTS)}
    for (used, _), cases in alike.items():
        section = SHARED if len({case.layout for case in cases}) > 1 else cases[0].layout
        same = len({case.text for case in cases}) == 1
        text = cases[0].text if same else _LEADING_PATH.sub("FILE", cases[0].text)
        problem = _problem(cases, section == SHARED) + (f" (*{used}*)" if used else "")
        sections[section].append(problem + " | `" + text.replace("|", r"\|") + "`\n")
    head = "\n## {}\n\nproblem | message\n--- | ---\n"
    return HEAD + "".join(head.format(name) + "".join(rows) for name, rows in sections.items() if rows)


_LEADING_PATH = re.compile(r"^DATA[\w./*-]*")


def _pattern(text: str) -> str:
    """A message with placeholders for file names and numbers."""
    named = re.sub(r"\([\w./]+\)|[\w./]+\.(png|txt|bin)", "NAME", _LEADING_PATH.sub("FILE", text))
    return re.sub(r"\d+", "N", named)


def _problem(cases: list[Case], name_layouts: bool) -> str:
    """The faults that share a message, each with the layouts in which it occurs if `name_layouts`."""
    layouts: dict[str, list[str]] = {}
    for case in cases:
        layouts.setdefault(case.what, []).append(case.layout)
    return "; ".join(f"{what} ({', '.join(of)})" if name_layouts else what for what, of in layouts.items())


def _skip_without_package_of(layout: str) -> None:
    if layout in NEEDS:
        pytest.importorskip(NEEDS[layout])


@pytest.mark.thorough
@pytest.mark.parametrize("layout", LAYOUTS)
def test_sound_data_raises_no_warnings(layout):
    _skip_without_package_of(layout)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DataWarning)
        LAYOUTS[layout].read(_sound(layout))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("layout", "fault"), [pytest.param(*case, id=f"{case[0]}-{case[1].what}") for case in CASES]
)
def test_messages_name_the_file_and_say_what_to_do(layout, fault, tmp_path):
    _skip_without_package_of(layout)
    refused, message = outcome_of(layout, fault, tmp_path)
    assert all(name in message for name in fault.names), message
    if refused:
        before, _, advice = message.rpartition("found ") if "found " in message else ("", "", message)
        assert re.search(r"[.!?] [A-Z][^.]*[a-z].*[.?]?$", advice), message
        assert not before or "expected " in before, message
    else:
        assert "left out" in message or re.search(r"[.;?] .*\b(give|set) ", message), message


@pytest.mark.thorough
def test_the_page_and_the_messages_are_up_to_date(tmp_path):
    for layout in NEEDS:
        _skip_without_package_of(layout)
    found = found_in(tmp_path)
    for path, text in ((PAGE, page(found)), (MESSAGES, messages(found))):
        assert path.read_text(encoding="utf-8") == text, "run python -m tests.data.test_reader_errors"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        found = found_in(Path(folder))
    PAGE.write_text(page(found), encoding="utf-8")
    MESSAGES.write_text(messages(found), encoding="utf-8")
