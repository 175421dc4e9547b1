"""Standard streams whose errors never end a run: output that cannot be delivered is dropped.

Output may be closed (`>&-`), its reader may go away (`| head`), its disk may be full, its terminal may be
gone, and its encoding may lack a character.
"""

import errno
import io
import os
import select
import sys
from typing import TextIO

from rich.console import Console
from rich.text import Text

_NOBODY_READS = (errno.EPIPE, errno.EBADF, errno.EIO)
"""Errors of a pipe without a reader, of a closed stream, and of a terminal that is gone."""


class _Output(io.FileIO):
    """The file of a stream. `lost` is the first error that made it drop output, or None."""

    lost: OSError | None = None

    def write(self, data, /) -> int:
        """Write or drop all of the data; returns its number of bytes."""
        size = memoryview(data).nbytes
        try:
            while (written := super().write(data)) is None:  # another program made the stream non-blocking
                select.select([], [self], [])
        except OSError as error:
            self.lost = self.lost or error
            return size
        return written


def keep_streams_open() -> None:
    """Replace stdout and stderr of this process by streams that ignore errors.

    File descriptors of closed streams are occupied too: otherwise a file opened later would get one, and
    whatever a library prints would end up in that file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number
    sys.stdout, sys.stderr = _kept_open(sys.stdout), _kept_open(sys.stderr)


def lost_output() -> str | None:
    """Why a part of stdout was lost, in words; None if all was written, or if nobody reads it."""
    sys.stdout.flush()
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    lost = raw.lost if isinstance(raw, _Output) else None
    return None if lost is None or lost.errno in _NOBODY_READS else lost.strerror


def say_error(text: str, word: str = "error") -> None:
    """Print one paragraph on stderr, wrapped only in a terminal, so that programs can search it."""
    console = Console(stderr=True, highlight=False)
    line = Text.assemble((f"{word}: ", "bold red"), text.removeprefix(f"{word} "))
    console.print(line, soft_wrap=not console.is_terminal)


def _kept_open(stream: TextIO | None) -> TextIO:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False)),
        encoding=stream.encoding,
        errors="replace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
