"""The tests that README.md of this folder names exist, and CI, which leaves slow ones out, runs them."""

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
        found = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and node.name == test]
        assert found or not test, guard
        marks = [ast.unparse(mark) for node in found for mark in node.decorator_list]
        assert "pytest.mark.slow" not in marks, guard


def test_there_are_promises():
    assert len(ROWS) > 20
