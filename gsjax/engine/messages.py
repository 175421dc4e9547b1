"""What goes wrong is said in a sentence: errors of the user's making, and warnings, each kind once."""

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

FITTING = "fitting the scene to the first frame, which takes half a minute to two"
COMPILING = "compiling the update, which takes a minute or two the first time"
MEASURING = "measuring what updates cost; each setting takes a minute or two to compile the first time"
_PACKAGE = Path(__file__).parents[1]


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
    def warnings(self) -> list[str]:
        """The warnings, of each kind the first."""
        return list(self._first.values())

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
