"""An on-disk cache of the outputs of encoders and segmenters, keyed by a hash of their inputs."""

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gsjax.io.arrays import ArraysError, load_arrays
from gsjax.io.atomic import write_npz
from gsjax.io.cache import user_cache

Arrays = Mapping[str, np.ndarray]


def cache_folder() -> Path | None:
    """The default folder of the cache; its contents may be deleted. None for a user without a home."""
    root = user_cache()
    return None if root is None else root / "features"


class FeatureCache:
    """Outputs kept in the user's cache folder, if there is one. Damaged outputs are computed again; outputs
    that cannot be written are not kept.

    Attributes:
        found, asked: number of outputs found in the cache, and of those that had to be computed.
    """

    def __init__(self):
        self._folder = cache_folder()
        self.found = self.asked = 0

    def __call__(self, key: str, inputs: Arrays, compute: Callable[[], Arrays]) -> dict[str, np.ndarray]:
        """The output for some inputs, from the cache or computed.

        Args:
            key: everything else that the output depends on: the encoder, its weights, its settings.
            inputs: arrays.
            compute: computes the output.
        """
        if self._folder is None:
            self.asked += 1
            return dict(compute())
        path = self._folder / f"{content_digest(key, inputs)}.npz"
        try:
            output = load_arrays(path)
            self.found += 1
            return output
        except (OSError, ArraysError):
            pass
        output = dict(compute())
        self.asked += 1
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_npz(path, output)
        except OSError:  # such as a full disk; the output is computed again next time
            pass
        return output


def folder_digest(folder: Path) -> str:
    """SHA-256 over the names and contents of the files in a folder; it identifies weights."""
    digest = hashlib.sha256()
    for file in sorted(entry for entry in folder.iterdir() if entry.is_file()):
        with open(file, "rb") as stream:
            digest.update(f"{file.name}|{hashlib.file_digest(stream, 'sha256').hexdigest()}|".encode())
    return digest.hexdigest()


def content_digest(key: str, inputs: Arrays) -> str:
    """SHA-256 over a key and arrays, as for `FeatureCache`."""
    digest = hashlib.sha256(json.dumps(key).encode())
    for name, array in sorted(inputs.items()):
        array = np.ascontiguousarray(array)
        digest.update(f"{name}|{array.dtype.str}|{array.shape}|".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()
