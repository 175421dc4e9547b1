"""The errors and warnings for data that is unusable or only partly usable, and how they list names."""

from collections.abc import Iterable

from gsjax.io.brief import brief

COMPLETE = "Was the folder copied completely?"
"""The advice where a file is missing that others tell of."""
_LONGEST, _EXPECTED = 200, 800  # characters of a name, and of all that may be expected


class DataError(ValueError):
    """A file or folder that cannot be used: its path, what was expected, what was found, what to do."""

    def __init__(self, path: object, expected: str, found: str, advice: str):
        super().__init__(f"{path}: expected {brief(expected, _EXPECTED)}, found {brief(found)}. {advice}")
        self.path = str(path)


class MissingFile(DataError):
    """An image or array of a frame is not where it should be."""


class DataWarning(UserWarning):
    """Data that is used although part of it is missing or unusable."""


def shortened(names: Iterable[str], most: int = 3) -> str:
    """Names joined for a message, shortened to the first few if there are many; the middle of endless ones is
    left out.

    Args:
        names: the names.
        most: how many are listed.
    """
    names = list(names)
    return ", ".join(brief(name, _LONGEST) for name in names[:most]) + (", ..." if len(names) > most else "")
