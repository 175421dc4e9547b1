"""The tests named in this folder's README.md exist and run in CI, which leaves slow tests out."""

import ast
import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROWS = re.findall(r"^\| (.+?) \| (`.+`) \|$", (HERE / "README.md").read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize(("promise", "guards"), ROWS, ids=[promise for promise, _ in ROWS])
def test_it_is_guarded(promise, guards):
    for guard in re.findall(r"`(.+?)`", guards):
        name, _, test = guard.partition("::")
        tree = ast.parse((HERE / name).read_text(encoding="utf-8"))
        found = [is_slow(marks) for marks in marks_of(tree, test)]
        assert found or not test, f"{guard}: no such test"
        assert not all(found or [False]), f"{guard}: slow, so CI leaves it out"


def marks_of(tree, test):
    """Returns the marks of each test of that name: its own, its class's and its file's."""
    of_file = [ast.unparse(line) for line in tree.body if isinstance(line, ast.Assign)]
    of_file = [line.removeprefix("pytestmark = ") for line in of_file if line.startswith("pytestmark")]
    marks = []
    for within in (tree, *(node for node in tree.body if isinstance(node, ast.ClassDef))):
        for node in within.body:
            if isinstance(node, ast.FunctionDef) and node.name == test:
                decorators = node.decorator_list + getattr(within, "decorator_list", [])
                marks.append([ast.unparse(each) for each in decorators] + of_file)
    return marks


def is_slow(marks):
    """Whether a whole test is marked slow; marks of single cases in `parametrize` do not count."""
    return any(mark.lstrip("[").startswith("pytest.mark.slow") for mark in marks)


@pytest.mark.parametrize(
    ("text", "slow"),
    [
        ("def test_a(): ...", False),
        ("@pytest.mark.slow\ndef test_a(): ...", True),
        ("@pytest.mark.slow\nclass TestIt:\n    def test_a(self): ...", True),
        ("pytestmark = pytest.mark.slow\ndef test_a(): ...", True),
        ("@pytest.mark.slow\ndef test_b(): ...\ndef test_a(): ...", False),
        (
            "@pytest.mark.parametrize('x', [pytest.param(1, marks=pytest.mark.slow)])\ndef test_a(x): ...",
            False,
        ),
    ],
)
def test_marks_of_classes_and_files_count(text, slow):
    (marks,) = marks_of(ast.parse(text), "test_a")
    assert is_slow(marks) == slow


def test_there_are_promises():
    assert len(ROWS) > 20
