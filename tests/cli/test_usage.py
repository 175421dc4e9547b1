"""What `--help` shows, and the errors for options that do not exist."""

import re
from importlib import import_module
from itertools import pairwise

import pytest

from gsjax.cli import COMMANDS
from gsjax.engine.program import parse_options
from gsjax.engine.usage import expect_known, without_commas


def help_of(command, width, monkeypatch, capsys):
    """What --help prints in a terminal of this width."""
    monkeypatch.setenv("COLUMNS", str(width))
    with pytest.raises(SystemExit):
        parse_options(command, ["--help"], COMMANDS[command])
    return capsys.readouterr().out


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("command", ["fit", "track", "export", "query"])
def test_help_is_wrapped_once_and_says_no_empty_default(command, width, monkeypatch, capsys):
    said = help_of(command, width, monkeypatch, capsys)
    assert max(map(len, said.splitlines())) <= width
    assert not re.search(r"\(default: (:|False|None)?\)", said)
    assert "{None}" not in said.replace("everywhere {None}|INT", "")  # where None means all
    # A word begins a line only if it did not fit into the line above.
    lines = [line.strip("│") for line in said.splitlines()]
    for above, below in pairwise(lines):
        words, column = below.split(), len(below) - len(below.lstrip())
        if words and words[0][0].islower() and above[:column].strip() == "" and above.strip():
            assert len(above.rstrip()) + 1 + len(words[0]) > width - 4


def test_defaults_that_say_something_stay(monkeypatch, capsys):
    said = help_of("track", 120, monkeypatch, capsys)
    assert all(words in said for words in ("(default: 1.0)", "(default: all)", "(required)"))


@pytest.mark.parametrize(
    ("command", "given", "meant"),
    [
        ("fit", "--stpes", "did you mean --fit.steps?"),
        ("fit", "--steps", "did you mean --fit.steps?"),
        ("fit", "-out", "did you mean --out?"),
        ("fit", "--fit.stpes=3", "did you mean --fit.steps?"),
        ("fit", "--sede", "did you mean --seed or --fit.seed?"),
        ("track", "--test_evry", "no such option"),
        ("query", "--min-scor", "did you mean --min-score?"),
        ("poses", "--overwite", "did you mean --overwrite?"),
        ("experiment", "--schedular", "did you mean --scheduler?"),
    ],
)
def test_a_mistyped_option_is_guessed(command, given, meant):
    with pytest.raises(ValueError, match=re.escape(f"gsjax {command} --help lists all")) as refused:
        parse_options(command, ["x", given, "10"], COMMANDS[command])
    assert f"{given.split('=')[0].replace('_', '-')}: no such option" in str(refused.value)
    assert meant in str(refused.value)


def test_values_that_begin_with_a_dash():
    assert parse_options("export", ["a", "b.html", "--up", "-y"], COMMANDS["export"]).up == "-y"
    assert parse_options("info", ["--", "-scene.ply"], COMMANDS["info"]).path == "-scene.ply"
    assert parse_options("query", ["run", "http://a"], COMMANDS["query"]).text == "http://a"


def test_numbers_of_a_list_may_be_separated_by_commas():
    given = ["x", "--out", "1,2", "--read.K=1,2,3,4", "--read.K", "525,525.5,-3e2,240", "--cameras", "0,2"]
    expected = [
        "x",
        "--out",
        "1,2",
        "--read.K",
        "1",
        "2",
        "3",
        "4",
        "--read.K",
        "525",
        "525.5",
        "-3e2",
        "240",
    ]
    kind = import_module(COMMANDS["track"][0]).Options
    assert without_commas(kind, given) == [*expected, "--cameras", "0", "2"]
    texts = ["x", "y", "--negatives", "1,2"]
    assert without_commas(import_module(COMMANDS["query"][0]).Options, texts) == texts
    options = parse_options("track", ["x", "--out", "y", "--read.K", "5,6,7,8"], COMMANDS["track"])
    assert options.read.K == (5, 6, 7, 8)


@pytest.mark.parametrize(
    ("command", "arguments", "says"),
    [
        ("info", ["https://a.com/a.ply"], "https://a.com/a.ply: expected a path, found an address; download"),
        ("export", ["http://a", "b"], "http://a: expected a path, found an address"),
        ("fit", ["s3://a/b", "--out", "c"], "s3://a/b: expected a path, found an address"),
        ("fit", ["a", "--resume", "-v"], "-v: no such option; gsjax fit --help"),
    ],
)
def test_what_is_no_option(command, arguments, says):
    with pytest.raises(ValueError, match=says):
        parse_options(command, arguments, COMMANDS[command])


@pytest.mark.parametrize("command", ["fit", "deform", "query", "poses", "distill"])
def test_every_option_of_a_command_is_known(command, monkeypatch, capsys):
    said = help_of(command, 120, monkeypatch, capsys)
    shown = re.findall(r"^[│ ] (--[\w.-]+)", said, re.MULTILINE)
    assert len(shown) > 5
    expect_known(import_module(COMMANDS[command][0]).Options, command, shown)
