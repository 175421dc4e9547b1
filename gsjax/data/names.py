"""Lookup of files by the names in a dataset, which may have been written on another system."""

import os
import re
import unicodedata
from functools import lru_cache
from pathlib import Path

_ESCAPES = {"\a": "/a", "\b": "/b", "\f": "/f", "\n": "/n", "\r": "/r", "\t": "/t", "\v": "/v"}
_SLASHES = str.maketrans({"\\": "/"} | _ESCAPES)
_ABSOLUTE = re.compile(r"[A-Za-z]:/|/")


def portable(name: str) -> str:
    """The name with forward slashes, even where backslashes were read as escapes, as in images\\frame."""
    return name.strip().translate(_SLASHES)


def find_file(root: Path, name: str, suffixes: tuple[str, ...] = ()) -> Path | None:
    """The file that a name refers to; None if there is none.

    The name is tried as written, then with forward slashes, regardless of case and of the Unicode form of
    accents. An absolute path that does not exist is matched by as many of its last parts as exist in the
    folder.

    Args:
        root: the folder that names are relative to.
        name: the name.
        suffixes: extensions, in lower case, that the name may lack.
    """
    endings = ("", *suffixes)
    for ending in endings:
        if os.path.isfile(path := root / f"{name}{ending}"):
            return path
    wanted = portable(name)
    absolute = _ABSOLUTE.match(wanted)
    parts = [part for part in wanted[absolute.end() if absolute else 0 :].split("/") if part not in ("", ".")]
    for start in range(len(parts)) if absolute else (0,):
        for ending in endings:
            if parts and (path := _walk(root, [*parts[start:-1], f"{parts[-1]}{ending}"])) is not None:
                return path
    return None


def _walk(folder: Path, parts: list[str]) -> Path | None:
    for i, part in enumerate(parts):
        inside = {} if part == ".." else _entries(folder)
        matches = [part] if part == ".." else inside.get(_key(part), [])
        if part in matches:
            folder /= part
        elif len(matches) == 1:
            folder /= matches[0]
        else:
            return None
        if i < len(parts) - 1 and not os.path.isdir(folder):
            return None
    return folder if os.path.isfile(folder) else None


def _entries(folder: Path) -> dict[str, list[str]]:
    try:
        return _listed(str(folder), os.stat(folder).st_mtime_ns)
    except (OSError, ValueError):
        return {}


@lru_cache(maxsize=64)
def _listed(folder: str, changed_ns: int) -> dict[str, list[str]]:
    entries: dict[str, list[str]] = {}
    for name in os.listdir(folder):
        entries.setdefault(_key(name), []).append(name)
    return entries


def _key(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
