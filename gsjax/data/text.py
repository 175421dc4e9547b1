"""Text files of any system: their encoding, line endings and field separators."""

import codecs
import re
from contextlib import suppress

# UTF-32 comes first: its little-endian byte order mark begins with that of UTF-16.
_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_LINE_ENDS = re.compile(r"\r+\n|\r")
_SEPARATORS = re.compile(r"[\s,;]+")
_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"(?<=\d),(?=\d)")
_NUMBER = r"[-+]?\d+(?:,\d+)?(?:[eE][-+]?\d+)?"
_DECIMAL_LINE = re.compile(rf"\s*{_NUMBER}(?:\s+{_NUMBER})+\s*")


def decoded(content: bytes) -> str:
    """Decode bytes to text with lines that end in a newline: by their byte order mark, else as UTF-8 (or
    UTF-16, recognised by its zero bytes), else as Windows-1252.

    Raises:
        ValueError: the bytes are not text.
    """
    marked = next((name for mark, name in _MARKS.items() if content.startswith(mark)), None)
    text = content.decode(marked) if marked else _guessed(content)
    if "\0" in text:
        raise ValueError("zero bytes")
    return _LINE_ENDS.sub("\n", text) if "\r" in text else text  # most have none, and the search is slow


def _guessed(content: bytes) -> str:
    for name in ("utf-8", *_unmarked(content)):
        with suppress(UnicodeDecodeError):
            if "\0" not in (text := content.decode(name)):
                return text
    return content.decode("cp1252", errors="replace")


def _unmarked(content: bytes) -> list[str]:
    """Candidates for UTF-16 without a byte order mark, which has a zero byte beside each Latin letter."""
    zeros = [content[start:200:2].count(0) for start in (0, 1)]
    return [name for name, share in (("utf-16-be", zeros[0]), ("utf-16-le", zeros[1])) if share > 20]


def fields(line: str) -> list[str]:
    """The fields of a line, separated by spaces, tabs, commas or semicolons, without quotes.

    Commas are decimal marks in a line with semicolons, within quotes, and in a line of numbers that are
    separated by spaces or tabs and have at most one comma each.

    Args:
        line: a line of text.
    """
    if ";" in line or ("," in line and _DECIMAL_LINE.fullmatch(line)):
        line = line.replace(",", ".")
    elif '"' in line:
        line = _QUOTED.sub(lambda match: _DECIMAL_COMMA.sub(".", match[0]), line)
    return [field.strip("\"'") for field in _SEPARATORS.split(line.strip()) if field]
