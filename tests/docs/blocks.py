"""Finds the code blocks of the documentation, runs those in Python and checks the commands in others."""

import re
import shlex
import textwrap
import tomllib
from pathlib import Path
from typing import NamedTuple

from gsjax.cli import COMMANDS
from gsjax.engine.experiments.sweep import experiment_names
from gsjax.engine.program import parse_options

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/**/*.md"))
PAGES = ["README.md", "CONTRIBUTING.md", *PAGES]
SHELLS = ("sh", "bash", "console")

_FENCE = re.compile(r"^(?P<indent> *)```(?P<language>\w*)")
_NOT_RUN = re.compile(r"<!--\s*not run:(.*?)-->", re.DOTALL)


class Block(NamedTuple):
    """A fenced block of a page.

    Attributes:
        page: its path below the root.
        line: the line on which it begins, counted from 1.
        language: the language named after the fence, or empty.
        text: its content.
        not_run: why it is not run, from a comment `<!-- not run: why -->` before it; None if it is run.
    """

    page: str
    line: int
    language: str
    text: str
    not_run: str | None

    @property
    def place(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(page: str) -> list[Block]:
    """The fenced blocks of a page, in order."""
    found, before, lines = [], "", iter(enumerate((ROOT / page).read_text(encoding="utf-8").splitlines(), 1))
    for number, line in lines:
        if not (fence := _FENCE.match(line)):
            before = before + "\n" + line if line.strip() else before
            continue
        inside = []
        for _, line in lines:
            if line.strip() == "```":
                break
            inside.append(line)
        why = re.search(_NOT_RUN.pattern + r"\s*\Z", before, re.DOTALL)
        text = textwrap.dedent("\n".join(inside)) + "\n"
        found.append(Block(page, number, fence["language"], text, why and why[1].strip()))
        before = ""
    return found


def programs(page: str) -> list[Block]:
    """The Python blocks of a page that are run."""
    return [block for block in blocks(page) if block.language == "python" and block.not_run is None]


def run_programs(page: str) -> dict:
    """Runs the Python blocks of a page in order, in one namespace, and returns that."""
    names: dict = {}
    for block in programs(page):
        padded = "\n" * block.line + block.text  # so that a traceback names the page's own lines
        exec(compile(padded, str(ROOT / page), "exec"), names)
    return names


def commands(block: Block) -> list[list[str]]:
    """The words of each command in a shell block, without comments and leading variable assignments."""
    text = block.text.replace("\\\n", " ")
    lines = [line.removeprefix("$ ") for line in text.splitlines()]
    split = [shlex.split(line, comments=True) for line in lines]
    return [words[_settings(words) :] for words in split if words]


def check_command(words: list[str]) -> None:
    """Raises an error if gsjax, make, pip or Python would not understand a command; nothing is run."""
    program, rest = Path(words[0]).name, words[1:]
    if program == "gsjax":
        _check_gsjax(rest)
    elif program == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        assert rest in [[target] for target in targets], f"make {rest}: there are {targets}"
    elif program == "pip" or rest[:2] == ["-m", "pip"]:
        _check_pip(rest[rest.index("install") + 1 :])
    elif program.startswith("python"):
        _check_python(rest)
    elif program == "run":
        assert (ROOT / words[0]).is_file(), words[0]
    else:
        raise AssertionError(f"{words[0]}: not known here; is there a reason for <!-- not run: ... -->?")


def _settings(words: list[str]) -> int:
    """The number of leading words that set variables, as in `MUJOCO_GL=egl gsjax ...`."""
    return next((i for i, word in enumerate(words) if not re.match(r"[A-Z_]+=", word)), len(words))


def _check_gsjax(words: list[str]) -> None:
    command, arguments = words[0], words[1:]
    assert command in COMMANDS, f"gsjax {command}: there are {list(COMMANDS)}"
    try:
        parse_options(command, arguments, COMMANDS[command])
    except SystemExit as refused:
        raise AssertionError(f"gsjax {shlex.join(words)}: its options are not understood") from refused
    if command == "experiment" and arguments[0] != "list":
        expect_experiment(arguments[1])


def expect_experiment(name: str) -> None:
    """Raises an error if there is no such experiment; NAME is a placeholder for any."""
    assert name == "NAME" or name in experiment_names(ROOT / "experiments"), f"no experiment {name}"


def _check_pip(wanted: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for word in wanted:
        if found := re.fullmatch(r"(?:gsjax|\.)\[(.+)\]", word):
            unknown = set(found[1].split(",")) - set(project["optional-dependencies"])
            assert not unknown, f"pip install {word}: no extra {unknown}"


def _check_python(words: list[str]) -> None:
    if words[0] == "-m":
        path = words[1].replace(".", "/")
        own = (ROOT / path.split("/")[0]).is_dir()
        assert not own or (ROOT / f"{path}.py").is_file() or (ROOT / path).is_dir(), f"no module {words[1]}"
    else:
        assert (ROOT / words[0]).is_file(), f"no script {words[0]}"
