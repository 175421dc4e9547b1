"""The lowest versions of dependencies, and the version of gsjax, as pyproject.toml gives them."""

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

import gsjax

_spec = importlib.util.spec_from_file_location("floors", Path(__file__).with_name("floors.py"))
floors = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(floors)

PROJECT = tomllib.loads(floors.PROJECT.read_text(encoding="utf-8"))["project"]


def test_every_dependency_has_a_floor():
    found = floors.floors(PROJECT, list(PROJECT["optional-dependencies"]))
    assert {"jax", "numpy", "viser", "torch", "ruff"} <= set(found)


def test_an_extra_takes_in_others():
    made_up = {
        "name": "toy",
        "dependencies": ["a>=1.2"],
        "optional-dependencies": {"one": ["b[c]>=3"], "two": ["toy[one]", "d==4"], "three": ["e>=5"]},
    }
    assert floors.floors(made_up, []) == {"a": "1.2"}
    assert floors.floors(made_up, ["two"]) == {"a": "1.2", "b": "3", "d": "4"}


@pytest.mark.parametrize("requirement", ["b", "b<3", "b>=1,<2", "a>=2"])
def test_what_has_no_floor_or_two_is_named(requirement):
    made_up = {"name": "toy", "dependencies": ["a>=1", requirement], "optional-dependencies": {}}
    with pytest.raises(ValueError, match=r"pyproject\.toml: .*(lowest versions|VERSION)"):
        floors.floors(made_up, [])


def test_an_unknown_extra_is_named():
    with pytest.raises(ValueError, match=r"expected one of the extras .*found 'nothing'"):
        floors.floors(PROJECT, ["nothing"])


def test_the_version_is_the_same_in_all_three_places():
    assert gsjax.__version__ == PROJECT["version"]
    cited = re.search(
        r"^version: (.*)$", (Path(__file__).resolve().parents[1] / "CITATION.cff").read_text(), re.MULTILINE
    )
    assert cited[1] == gsjax.__version__
