"""What goes wrong is said in a sentence: errors of the user's making, and warnings, each kind once."""

import re
import select
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from gsjax.cli.machine import keep_to_cores
from gsjax.data.errors import DataWarning
from gsjax.extras import MissingExtra

FITTING = "fitting the scene to the first frame, which takes half a minute to two"
COMPILING = "compiling the update, which takes a minute or two the first time"
MEASURING = "measuring what updates cost; each setting takes a minute or two to compile the first time"

# ValueError covers DataError and PlyError, and whatever an argument is checked for.
USER_ERRORS = (ValueError, OSError, MissingExtra)
_COMPILE_ANEW = ("bench", "experiment")  # they measure how long that takes
_PACKAGE = Path(__file__).parents[1]


def run_politely(command: str, arguments: list[str], entry: tuple[str, str]) -> int:
    """Parse the options of a command and run it. A user's mistake becomes a sentence and exit code 2.

    Args:
        command: its name.
        arguments: what stands behind the name.
        entry: its module, and what it does.
    """
    try:
        options = parse_options(command, arguments, entry)
        keep_to_cores(getattr(options, "cores", None))  # before JAX looks how many there are
        compiler = import_module("gsjax.optim.compiler")
        compiler.keep_freed_memory()
        if command not in _COMPILE_ANEW:
            compiler.keep_programs()
        return import_module(entry[0]).run(options)
    except Exception as error:
        if "--debug" in arguments or (isinstance(error, BrokenPipeError) and is_unread()):
            raise
        if isinstance(error, USER_ERRORS):
            say_error(describe(error))
            return 2
        told = f"a fault of gsjax itself: {type(error).__name__}: {describe(error)}"
        say_error(f"{told}. Please report it with what --debug shows")
        return 1


def is_unread() -> bool:
    """Whether what is printed goes into a pipe that nobody reads any more, as after `| head`."""
    if not hasattr(select, "poll"):
        return False
    output = select.poll()
    output.register(sys.__stdout__, select.POLLOUT)
    return any(events & select.POLLERR for _, events in output.poll(0))


def parse_options(command: str, arguments: list[str], entry: tuple[str, str]) -> Any:
    """The options of a command, without running it.

    Args:
        command: its name.
        arguments: what stands behind the name.
        entry: its module, and what it does.

    Raises:
        ValueError: a list was begun and left empty.
        SystemExit: the arguments were not understood, or ask for help; what there is to say is printed.
    """
    import tyro

    module, does = entry
    chosen = import_module(module)
    options_for = getattr(chosen, "options_for", lambda given: (chosen.Options, given))
    kind, arguments = options_for(arguments)
    options = tyro.cli(
        kind,
        prog=f"gsjax {command}",
        description=f"{does[0].upper()}{does[1:]}." + getattr(chosen, "HELP", ""),
        args=arguments,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    _expect_values(options, arguments)
    return options


def _expect_values(options: Any, arguments: list[str]) -> None:
    """Raises a ValueError for a list that was begun and left empty, where that would mean all there is."""
    given = {argument.replace("_", "-") for argument in arguments}
    for field in fields(options):
        flag = "--" + field.name.replace("_", "-")
        if getattr(options, field.name) == field.default == () and flag in given:
            raise ValueError(f"{flag}: expected one value or more, found none")


@contextmanager
def stage(console: Console, words: str) -> Iterator[None]:
    """Say what takes a while: a spinner for people, a line for a log."""
    if console.is_terminal:
        with console.status(words):
            yield
    else:
        console.print(words, soft_wrap=True)
        yield


def describe(error: BaseException) -> str:
    """An exception as one paragraph, without Python's own words where there are better ones."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}"
    return " ".join(str(error).split()) or type(error).__name__


def say_error(text: str, word: str = "error") -> None:
    """Print one paragraph on stderr. It is wrapped for people only, so that programs can search it."""
    console = Console(stderr=True, highlight=False)
    line = Text.assemble((f"{word}: ", "bold red"), text.removeprefix(f"{word} "))
    console.print(line, soft_wrap=not console.is_terminal)


def counted(count: int, noun: str) -> str:
    """So many of something: "1 part", "2 parts"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def reason(stopped: BaseException) -> str:
    """What stopped a run, in words."""
    return "Ctrl-C" if isinstance(stopped, KeyboardInterrupt) else describe(stopped)


class Notes:
    """Collects what a run has to say for itself, and shows each kind of warning once.

        with Notes(console) as notes: ...

    While the block runs, warnings of gsjax are printed plainly to the console. Two that differ in numbers
    only (one for each frame, say) are of one kind.
    """

    def __init__(self, console: Console):
        self._console = console
        self._first: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._added: list[str] = []

    def add(self, text: str) -> None:
        """Note something for the report without printing it."""
        self._added.append(text)

    def warn(self, text: str) -> None:
        """Print a warning, unless one of its kind was printed before, and note it."""
        kind = re.sub(r"\d+(\.\d+)?", "#", text)
        self._counts[kind] += 1
        if kind not in self._first:
            self._first[kind] = text
            line = Text.assemble(("warning: ", "bold yellow"), text)
            self._console.print(line, soft_wrap=not self._console.is_terminal)

    @property
    def all(self) -> list[str]:
        """The notes, then the warnings; of many of one kind the first, with their number."""
        more = {kind: count - 1 for kind, count in self._counts.items()}
        tail = {k: f" (and {n} more like it)" if n else "" for k, n in more.items()}
        return [*self._added, *(f"Warning: {text}{tail[kind]}" for kind, text in self._first.items())]

    def __enter__(self) -> "Notes":
        self._caught = warnings.catch_warnings()
        self._caught.__enter__()
        warnings.simplefilter("always", DataWarning)
        warnings.filterwarnings("always", category=UserWarning, module=r"gsjax(\.|$)")
        show = warnings.showwarning

        def showwarning(message, category, filename, lineno, file=None, line=None):
            if issubclass(category, DataWarning) or (
                issubclass(category, UserWarning) and Path(filename).is_relative_to(_PACKAGE)
            ):
                self.warn(" ".join(str(message).split()))
            elif sys.warnoptions:  # who asked Python for warnings gets the others too
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = showwarning
        return self

    def __exit__(self, *exception) -> None:
        self._caught.__exit__(*exception)
