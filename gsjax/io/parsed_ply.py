"""Parses PLY files of any elements with plyfile, after checking that their headers are plausible."""

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
_END = re.compile(rb"[\r\n]end_header[ \t]*(?:[\r\n]|$)")


def parse_ply(path: Path) -> PlyData:
    """The elements of a PLY file.

    Raises:
        ValueError: it cannot be parsed; the message says why.
        OSError: it cannot be read.
    """
    from plyfile import PlyData, PlyParseError

    least, size = _least_size(path), path.stat().st_size
    if least > size:
        raise ValueError(f"{size:,} bytes, where its header promises {least:,} or more")
    try:
        return PlyData.read(str(path))
    except (PlyParseError, OverflowError, MemoryError) as error:
        raise ValueError(str(error)) from error


def _least_size(path: Path) -> int:
    """The fewest bytes that can hold a file's header and the rows that it promises. It is checked because
    plyfile allocates rows of lists before it reads them.

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
    return least - text  # the last line may end without a break
