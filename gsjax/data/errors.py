"""The errors and warnings for data that is unusable or only partly usable."""


class DataError(ValueError):
    """A file or folder that cannot be used: its path, what was expected, what was found, what to do."""

    def __init__(self, path: object, expected: str, found: str, advice: str):
        super().__init__(f"{path}: expected {expected}, found {found}. {advice}")
        self.path = str(path)


class MissingFile(DataError):
    """An image or array of a frame is not where it should be."""


class DataWarning(UserWarning):
    """Data that is used although part of it is missing or unusable."""
