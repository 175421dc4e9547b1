"""Every code block of the documentation: Python runs, commands have options that exist, YAML can be read."""

import contextlib
import io
import re
from collections import Counter

import pytest
import yaml

from gsjax.cli import COMMANDS
from gsjax.engine.program import parse_options
from tests.docs.blocks import (
    PAGES,
    ROOT,
    SHELLS,
    blocks,
    check_command,
    commands,
    expect_experiment,
    programs,
    run_programs,
)

NOT_RUN = {
    "docs/experiments.md": 1,
    "docs/from-gsplat.md": 1,
    "docs/many-devices.md": 1,
    "docs/scores.md": 2,
    "docs/semantics.md": 1,
    "docs/track.md": 2,
    "docs/view.md": 3,
}
"""The number of blocks of each page that are not run. Each block says why; a new one is counted here."""


def test_what_is_not_run_says_why():
    kept = [block for page in PAGES for block in blocks(page) if block.not_run is not None]
    for block in kept:
        print(f"{block.place}: {block.not_run}")
        assert block.not_run, f"{block.place}: expected <!-- not run: why -->, found no reason"
    assert Counter(block.page for block in kept) == Counter(NOT_RUN)


LONG = ("composition", "howto/loss", "howto/step", "rasterizer", "semantics")
SLOW = {f"docs/{page}.md" for page in LONG}
"""Pages whose calls are also run by tests of methods and commands."""
OF_THE_FIVE = (
    "README.md",
    "docs/programs.md",
    *(f"docs/{verb}.md" for verb in ("fit", "track", "parts", "distill", "deform")),
)
"""Pages whose programs have tests of their own: test_readme.py, test_programs.py."""
PROGRAMS = [
    pytest.param(page, marks=pytest.mark.slow) if page in SLOW else page
    for page in PAGES
    if programs(page) and page not in OF_THE_FIVE
]


@pytest.mark.thorough
@pytest.mark.parametrize("page", PROGRAMS)
def test_the_programs_of_a_page_run_one_after_another(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_programs(page)


@pytest.mark.thorough
@pytest.mark.parametrize("page", PAGES)
def test_what_is_not_python_is_understood(page):
    for block in blocks(page):
        if block.language in SHELLS and block.not_run is None:
            for words in commands(block):
                check_command(words)
        elif block.language == "yaml":
            assert yaml.safe_load(block.text), block.place
        else:
            assert block.language in ("", "python", "yaml", *SHELLS), f"{block.place}: {block.language}"


@pytest.fixture(scope="module")
def flags() -> set[str]:
    """All options of all commands, as their help lists them."""
    asked = [(name, ["--help"]) for name in COMMANDS if name != "experiment"]
    asked += [("experiment", [what, "--help"]) for what in ("list", "table", "run")]
    asked += [("track", ["--preset", "paper", "--help"])]  # help lists only the flag that changes a default
    return {flag for name, arguments in asked for flag in _flags_of(name, arguments)}


def _flags_of(command: str, arguments: list[str]) -> set[str]:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        parse_options(command, arguments, COMMANDS[command])
    return set(re.findall(r"--[a-z](?:[\w.-]*\w)?", said.getvalue()))


OTHERS = {"--help", "--stride", "--xla", "--no-deps", "--nthreads"}
"""Options of scripts, XLA, pip and Dask that pages mention."""


@pytest.mark.thorough
@pytest.mark.parametrize("page", PAGES)
def test_options_and_experiments_that_are_named_in_passing_exist(page, flags):
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    for code in re.findall(r"`([^`\n]+)`", text):
        named = set(re.findall(r"(?<![\w-])--[a-z][a-zA-Z0-9.-]*", code))
        assert named <= flags | OTHERS, f"{page}: `{code}` names {named - flags}"
        for experiment in re.findall(r"gsjax experiment (?:run|table) ([\w/]+)", code):
            expect_experiment(experiment)
