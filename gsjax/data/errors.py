"""The errors and warnings for data that is unusable or only partly usable."""

from gsjax.io.brief import brief

COMPLETE = "Was the folder copied completely?"
"""The advice if a file is missing that other files refer to."""
_EXPECTED = 800  # largest length of what was expected, characters


class DataError(ValueError):
    """A file or folder cannot be used. The message has its path, what was expected and found, and advice."""

    def __init__(self, path: object, expected: str, found: str, advice: str):
        super().__init__(f"{path}: expected {brief(expected, _EXPECTED)}, found {brief(found)}. {advice}")
        self.path = str(path)


class MissingFile(DataError):
    """An image or array of a frame does not exist."""


class DataWarning(UserWarning):
    """Data that is used although part of it is missing or unusable."""
