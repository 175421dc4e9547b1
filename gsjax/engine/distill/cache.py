"""What encoders and segmenters said of pictures, kept on disk by the content of what they were shown."""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from platformdirs import user_cache_dir

from gsjax.io.atomic import write_npz

Arrays = Mapping[str, np.ndarray]
_READ_ERRORS = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


def cache_folder() -> Path:
    """Where answers are kept unless told; what lies there may be deleted."""
    return Path(user_cache_dir("gsjax", appauthor=False)) / "features"


class FeatureCache:
    """A folder of answers. One that is damaged is asked for again, and one that cannot be written is not.

    Attributes:
        found, asked: how many answers were there, and how many had to be worked out.
    """

    def __init__(self, folder: Path | None = None):
        """
        Args:
            folder: where; in the user's cache folder unless given.
        """
        self._folder = folder or cache_folder()
        self.found = self.asked = 0

    def __call__(self, who: str, shown: Arrays, ask: Callable[[], Arrays]) -> dict[str, np.ndarray]:
        """What `who` says of what is shown.

        Args:
            who: everything else that the answer depends on: which encoder, its weights, its settings.
            shown: arrays.
            ask: works it out.
        """
        path = self._folder / f"{content_digest(who, shown)}.npz"
        try:
            with np.load(path, allow_pickle=False) as stored:
                said = dict(stored)
            self.found += 1
            return said
        except _READ_ERRORS:
            pass
        said = dict(ask())
        self.asked += 1
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_npz(path, said)
        except OSError:  # a full disk, or no home: then it is worked out next time too
            pass
        return said


def folder_digest(folder: Path) -> str:
    """SHA-256 over the names and contents of a folder's files: which weights these are."""
    digest = hashlib.sha256()
    for file in sorted(entry for entry in folder.iterdir() if entry.is_file()):
        with open(file, "rb") as stream:
            digest.update(f"{file.name}|{hashlib.file_digest(stream, 'sha256').hexdigest()}|".encode())
    return digest.hexdigest()


def content_digest(who: str, shown: Arrays) -> str:
    """SHA-256 over what is shown to whom."""
    digest = hashlib.sha256(json.dumps(who).encode())
    for name, array in sorted(shown.items()):
        array = np.ascontiguousarray(array)
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
