"""Removal of photographs that a dataset lists twice, so that none is both fitted and held out."""

import os
import warnings
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int

from gsjax.data.errors import DataWarning
from gsjax.data.photographs import Photographs
from gsjax.io.brief import shortened

_SPLITS = ("train", "val", "test")
_NEAR = 0.01  # of the cameras' spread: poses of one picture by structure from motion differ a little
_NEAR_ANGLE = np.deg2rad(1.0)


def without_duplicates(photographs: Photographs) -> Photographs:
    """The photographs without duplicates: files that are listed again (also by another path), and copies of a
    file under another name that were taken from the same place at the same time.

    Of duplicates in several splits, the one in the latest of train, val and test is kept, so that no picture
    is both fitted and held out. Warns with DataWarning if some are left out, and counts them.
    """
    same = np.arange(photographs.num)  # the first duplicate of each
    for i, j in _pairs(photographs):
        same[same == same[j]] = same[i]
    groups = [np.flatnonzero(same == first) for first in np.unique(same)]
    kept = sorted(_chosen(group, photographs) for group in groups)
    if len(kept) == photographs.num:
        return photographs
    left_out = [photographs.names[i] for i in range(photographs.num) if i not in set(kept)]
    some = f"{len(left_out)} of {photographs.num} photographs are listed twice ({shortened(left_out)})"
    advice = "one of each is used, the rest are left out"
    warnings.warn(f"{photographs.name}: {some}: {advice}", DataWarning, stacklevel=3)
    return photographs.select(kept)


def _chosen(group: np.ndarray, photographs: Photographs) -> int:
    splits = photographs.splits
    if splits is None:
        return int(group[0])
    return int(max(group, key=lambda i: _SPLITS.index(splits[i]) if splits[i] in _SPLITS else -1))


def _pairs(photographs: Photographs) -> Iterator[tuple[int, int]]:
    """Pairs of duplicates, the earlier photograph first."""
    centers = np.linalg.inv(photographs.viewmats)[:, :3, 3]
    far = _NEAR * np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1))
    files: dict[tuple[int, int], int] = {}
    by_size: dict[int, list[int]] = {}
    paths = [Path(photographs.where("image", i)) for i in range(photographs.num)]
    for i, path in enumerate(paths):
        try:
            found = os.stat(path)
        except (OSError, ValueError):  # a frame of a video, say
            continue
        if (first := files.setdefault((found.st_dev, found.st_ino), i)) != i:
            yield first, i
        else:
            by_size.setdefault(found.st_size, []).append(i)
    for alike in (group for group in by_size.values() if len(group) > 1):
        by_content: dict[bytes, list[int]] = {}
        for i in alike:
            by_content.setdefault(blake2b(paths[i].read_bytes()).digest(), []).append(i)
        for group in by_content.values():
            for k, first in enumerate(group[:-1]):
                rest = np.array(group[k + 1 :])
                yield from ((first, int(i)) for i in rest[_near(photographs, first, rest, far)])


def _near(
    photographs: Photographs, first: int, rest: Int[np.ndarray, "n"], far: float
) -> Bool[np.ndarray, "n"]:
    """Which of the rest were taken within the distance `far` of the first one, with almost the same
    orientation and at the same time."""
    poses = np.linalg.inv(photographs.viewmats[[first, *rest]])
    near = np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1) <= far
    turns = np.einsum("nij,ij->n", poses[1:, :3, :3], poses[0, :3, :3])
    near &= turns >= 1 + 2 * np.cos(_NEAR_ANGLE)  # the trace of a rotation
    if photographs.times is not None:
        near &= photographs.times[rest] == photographs.times[first]
    return near
