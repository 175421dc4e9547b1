"""Parses PLY files of any elements with plyfile, after checking that their headers are plausible."""

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from plyfile import PlyData
else:
    PlyData = Any

_SIZES = {  # bytes; a list may be empty, and has a count of one byte or more
    **dict.fromkeys((b"short", b"ushort", b"int16", b"uint16"), 2),
    **dict.fromkeys((b"int", b"uint", b"float", b"int32", b"uint32", b"float32"), 4),
    **dict.fromkeys((b"double", b"float64"), 8),
}
_LONGEST_HEADER = 2**20  # bytes
# Bytes from 128 to 191, by which letters of one alphabet differ in UTF-8, stay distinct, so that names do.
_ASCII = bytes(range(128)) + bytes(range(64, 128)) + b"?" * 64
_END = re.compile(rb"[\r\n]end_header[ \t]*(?:[\r\n]|$)")


def parse_ply(path: Path) -> PlyData:
    """The elements of a PLY file.

    Raises:
        ValueError: it cannot be parsed; the message says why.
        OSError: it cannot be read.
    """
    from plyfile import PlyData, PlyParseError

    (end, least), size = _sizes(path), path.stat().st_size
    if least > size:
        raise ValueError(f"{size:,} bytes, where its header promises {least:,} or more")
    try:
        with _Stream(path, end) as stream:
            return PlyData.read(stream)
    except (PlyParseError, OverflowError, MemoryError) as error:
        raise ValueError(str(error)) from error


class _Stream(io.BufferedReader):
    """A file whose header is read as ASCII, since plyfile refuses all else and programs write names and dates
    there in any encoding."""

    def __init__(self, path: Path, end: int):
        super().__init__(io.FileIO(path))
        self._end = end  # of the header

    def read(self, size: int | None = -1, /) -> bytes:
        start = self.tell()
        data = super().read(size)
        return data.translate(_ASCII) if start < self._end else data


def _sizes(path: Path) -> tuple[int, int]:
    """The bytes of a file's header, and the fewest that can hold it and the rows that it promises. They are
    checked because plyfile allocates rows of lists before it reads them.

    Raises:
        ValueError: the header has no end, which plyfile would look for byte by byte.
    """
    with open(path, "rb") as stream:
        start = stream.read(_LONGEST_HEADER)
    if (end := _END.search(start)) is None:
        raise ValueError(f"no end_header in its first {_LONGEST_HEADER:,} bytes")
    least, count, text = end.end(), 0, False
    for words in map(bytes.split, start[: end.start()].splitlines()):
        if words[:2] == [b"format", b"ascii"]:
            text = True
        elif words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
            count = int(words[2][:18])  # more digits take no fewer bytes
        elif words[:1] == [b"property"]:
            least += count * (2 if text else _SIZES.get(words[1] if len(words) > 1 else b"", 1))
    return end.end(), least - text  # the last line may end without a break
