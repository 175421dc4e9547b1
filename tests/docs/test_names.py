"""Dotted names of gsjax in the documentation, in docstrings and in comments exist."""

import re
from importlib import import_module
from pathlib import Path

import pytest

from tests.docs.blocks import PAGES, ROOT

SOURCES = [
    str(path.relative_to(ROOT))
    for part in ("gsjax", "benchmarks", "experiments")
    for path in (ROOT / part).rglob("*.py")
]
DOTTED = re.compile(r"`(gsjax(?:\.[a-zA-Z_]\w*)+)")


def is_there(name: str) -> bool:
    """Whether a module, or something in it, has this name."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            thing = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            if not hasattr(thing, part):
                return part in getattr(thing, "__annotations__", {})
            thing = getattr(thing, part)
        return True
    return False


@pytest.mark.parametrize("file", [*PAGES, "CONTRIBUTING.md", "tests/README.md"])
def test_those_of_a_page(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    assert not [name for name in DOTTED.findall(text) if not is_there(name)]


def test_those_of_sources():
    named = {(name, file) for file in SOURCES for name in DOTTED.findall(Path(ROOT, file).read_text("utf-8"))}
    assert len(named) > 50
    assert not sorted(pair for pair in named if not is_there(pair[0]))


@pytest.mark.parametrize(
    "name", ["gsjax.nothing", "gsjax.methods.track.find_objects", "gsjax.FitConfig.stepz"]
)
def test_what_is_not_there_is_found(name):
    assert not is_there(name)
    assert is_there("gsjax.FitConfig.steps")
