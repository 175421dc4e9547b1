"""The errors and warnings for data that is unusable or only partly usable."""

from gsjax.io.brief import brief

COMPLETE = "Was the folder copied completely?"
"""The advice where a file is missing that others tell of."""
_EXPECTED = 800  # characters of all that may be expected


class DataError(ValueError):
    """A file or folder that cannot be used: its path, what was expected, what was found, what to do."""

    def __init__(self, path: object, expected: str, found: str, advice: str):
        super().__init__(f"{path}: expected {brief(expected, _EXPECTED)}, found {brief(found)}. {advice}")
        self.path = str(path)


class MissingFile(DataError):
    """An image or array of a frame is not where it should be."""


class DataWarning(UserWarning):
    """Data that is used although part of it is missing or unusable."""
