"""Labels of Gaussians, in a file beside their PLY: readers of 3DGS refuse or misread integer properties."""

import os
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Int, Integer

from gsjax.io.arrays import ArraysError, load_arrays
from gsjax.io.atomic import write_npz

ENDING = "_labels.npz"
_NAME = "labels"


def labels_beside(path: str | os.PathLike) -> Path:
    """The labels file of a PLY: scene_labels.npz for scene.ply."""
    path = Path(path)
    return path.with_name(path.stem + ENDING)


def write_labels(path: str | os.PathLike, labels: Integer[np.ndarray, "N"]) -> None:
    """Write the labels of the PLY at `path` beside it, atomically.

    Args:
        path: the PLY.
        labels: one for each of its rows.
    """
    write_npz(labels_beside(path), {_NAME: np.asarray(labels, np.int32)})


def read_labels(path: str | os.PathLike, count: int) -> Int[np.ndarray, "N"] | None:
    """The labels beside the PLY at `path`, one for each row; None if there are none or, with a warning, if
    they do not fit it.

    Args:
        path: the PLY.
        count: number of its rows.
    """
    file = labels_beside(path)
    if not file.is_file():
        return None
    expected = f"expected {count} integers called {_NAME}, one for each Gaussian of {Path(path).name}"
    try:
        found = load_arrays(file)[_NAME]
    except (ArraysError, KeyError):
        said = "a file without them"
    else:
        if found.shape == (count,) and np.issubdtype(found.dtype, np.integer):
            return found.astype(np.int32)
        said = f"{found.dtype} of shape {found.shape}"
    warnings.warn(f"{file}: {expected}, found {said}; they are left out", UserWarning, stacklevel=1)
    return None
