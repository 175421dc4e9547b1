"""Messages of commands: stages, errors in a sentence, and warnings, each kind once."""

import re
import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.text import Text

from gsjax.data.errors import DataWarning
from gsjax.io.brief import brief

FITTING = "fitting the scene to the first frame, and compiling meanwhile: a minute or two the first time"
COMPILING = "compiling what is left of the update"
MEASURING = "measuring what updates cost; each setting takes a minute or two to compile the first time"
_LONGEST = 500  # characters of a path
_PACKAGE = Path(__file__).parents[1]


@contextmanager
def stage(console: Console, words: str) -> Iterator[None]:
    """Announce work that takes a while: a spinner in a terminal, a line in a log."""
    if console.is_terminal:
        with console.status(Text(words)):
            yield
    else:
        console.print(Text(words), soft_wrap=True)
        yield


def describe(error: BaseException) -> str:
    """The message of an exception as one paragraph; errors of files begin with the path."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{brief(error.filename, _LONGEST)}: {error.strerror[0].lower()}{error.strerror[1:]}"
    if isinstance(error, FileNotFoundError) and error.errno is not None:  # without a name: from `os.getcwd`
        return "the working directory: expected a folder, found that it was removed; change into another (cd)"
    return " ".join(str(error).split()) or type(error).__name__


def counted(count: int, noun: str) -> str:
    """A number with its noun: "1 part", "2 parts"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def reason(stopped: BaseException) -> str:
    """The reason why a run was stopped."""
    if isinstance(stopped, KeyboardInterrupt):  # raised with the name of its signal, or by Python itself
        return "Ctrl-C" if str(stopped) in ("", "SIGINT") else str(stopped)
    return describe(stopped)


class Notes:
    """Collects the notes and warnings of a run, and prints each kind of warning once.

        with Notes(console) as notes: ...

    While the block runs, warnings of gsjax are printed plainly to the console. Two that differ only in
    numbers (one per frame, say) are of one kind. Those of other packages are hidden from users of the command
    line, unless Python runs with -W.

    Args:
        console: where warnings are printed.
        of_all: show warnings of other packages as usual.
    """

    def __init__(self, console: Console, of_all: bool = False):
        self._console, self._of_all = console, of_all or bool(sys.warnoptions)
        self._first: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._added: list[str] = []

    def add(self, text: str) -> None:
        """Note something for the report without printing it."""
        self._added.append(text)

    def say(self, text: str) -> None:
        """Note something for the report, and print it."""
        self.add(text)
        self._console.print(Text.assemble(("note: ", "bold"), text), soft_wrap=not self._console.is_terminal)

    def warn(self, text: str) -> None:
        """Note a warning, and print it unless one of its kind was printed before."""
        kind = re.sub(r"\d+(\.\d+)?", "#", text)
        self._counts[kind] += 1
        if kind not in self._first:
            self._first[kind] = text
            line = Text.assemble(("warning: ", "bold yellow"), text)
            self._console.print(line, soft_wrap=not self._console.is_terminal)

    @property
    def warnings(self) -> list[str]:
        """The first warning of each kind, with the number of the others."""
        more = {kind: count - 1 for kind, count in self._counts.items()}
        tail = {kind: f" (and {n} more like it)" if n else "" for kind, n in more.items()}
        return [f"{text}{tail[kind]}" for kind, text in self._first.items()]

    @property
    def all(self) -> list[str]:
        """The notes, then the warnings."""
        return [*self._added, *(f"Warning: {text}" for text in self.warnings)]

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
            elif self._of_all:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = showwarning
        return self

    def __exit__(self, *exception) -> None:
        self._caught.__exit__(*exception)
