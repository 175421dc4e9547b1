"""Text of any system: its encoding, the ends of its lines, and what separates its fields."""

import codecs
import re
from contextlib import suppress

# UTF-32's mark of little endian begins with UTF-16's.
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_LINE_ENDS = re.compile(r"\r+\n|\r")
_SEPARATORS = re.compile(r"[\s,;]+")


def decoded(content: bytes) -> str:
    """Text from bytes, with lines that end in a newline: by the mark at their start, else as UTF-8 (or
    UTF-16, told by its zeros), else as Windows-1252.

    Raises:
        ValueError: the bytes are no text.
    """
    marked = next((name for mark, name in _MARKS.items() if content.startswith(mark)), None)
    text = content.decode(marked) if marked else _guessed(content)
    if "\0" in text:
        raise ValueError("zero bytes")
    return _LINE_ENDS.sub("\n", text)


def _guessed(content: bytes) -> str:
    for name in ("utf-8", *_unmarked(content)):
        with suppress(UnicodeDecodeError):
            if "\0" not in (text := content.decode(name)):
                return text
    return content.decode("cp1252", errors="replace")


def _unmarked(content: bytes) -> list[str]:
    """UTF-16 without a mark has a zero byte beside each Latin letter."""
    zeros = [content[start:200:2].count(0) for start in (0, 1)]
    return [name for name, share in (("utf-16-be", zeros[0]), ("utf-16-le", zeros[1])) if share > 20]


def fields(line: str) -> list[str]:
    """The fields of a line, separated by spaces, tabs, commas or semicolons, without quotes. In a line with
    semicolons, commas are decimal marks."""
    if ";" in line:
        line = line.replace(",", ".")
    return [field.strip("\"'") for field in _SEPARATORS.split(line.strip()) if field]
