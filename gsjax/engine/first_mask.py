"""The mask of the first frame, which defines the objects to track."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Int

from gsjax.data import Sequence
from gsjax.data.errors import DataError
from gsjax.data.files import picture_size
from gsjax.data.masks import read_mask
from gsjax.data.pictures import is_picture
from gsjax.engine.messages import Notes
from gsjax.engine.recording import Recording
from gsjax.perception.codebook import distinct_names

KEPT_MASK = "mask.png"
"""File in which a run keeps the picture that defined its objects."""

PICTURE = "picture"
OWN_MASKS = ("files", "shapes")  # sources whose values are the recording's own
_MOST_OBJECTS, _LEAST_PIXELS = 100, 10  # in a picture of labels


class FirstMask(NamedTuple):
    """Labels of one camera's first image, the only ones that the tracker is given.

    Attributes:
        labels: [H, W]; 0 is background. None if objects are given as shapes.
        camera: id of the camera, or None.
        source: "files", "picture", "segment" or "shapes".
    """

    labels: Int[np.ndarray, "height width"] | None
    camera: int | None
    source: str

    @property
    def is_own(self) -> bool:
        """Whether the values are those of the recording, which may have names and true poses for them."""
        return self.source in OWN_MASKS


def first_mask(tracked: Sequence, camera: int | None, source: str | Path, scale: float = 1.0) -> FirstMask:
    """The mask of the first frame: from the recording, a picture, or the weight-free segmenter.

    Args:
        tracked: the tracked cameras.
        camera: id of the mask's camera; None takes the first that has masks.
        source: "files", "segment", or "auto": files, else the shapes of the recording, else the segmenter; or
            the path of a picture of labels.
        scale: size of the tracked pictures relative to the originals; labels may have either size.

    Raises:
        ValueError: the camera is not tracked, or has no mask; or the picture does not fit.
    """
    if camera is not None and camera not in tracked.camera_ids:
        raise ValueError(
            f"--mask-camera: camera {camera} is not tracked; the tracked ones are {list(tracked.camera_ids)}."
        )
    if isinstance(source, Path):
        return _from_picture(tracked, camera, source, scale)
    if source in ("auto", "files") and tracked.has_masks:
        for c, name in enumerate(tracked.camera_ids):
            labels = tracked.mask(0, c) if camera in (None, name) else None
            if labels is not None:
                _check_not_empty(labels, tracked, c)
                return FirstMask(labels, name, "files")
        if camera is not None and source == "auto":
            raise ValueError(
                f"--mask-camera: camera {camera} has no masks. Name another, or --masks segment."
            )
    if source == "files":
        other = "auto, which takes the shapes of this recording" if tracked.models else "segment"
        raise ValueError(
            f"--masks files: {tracked.name} has none for these cameras; use --masks {other}, or a picture."
        )
    if source == "auto" and not tracked.has_depth and tracked.models:
        return FirstMask(None, None, "shapes")
    from gsjax.perception.segmenters import PlaneOrRegionSegmenter

    name = tracked.camera_ids[0] if camera is None else camera
    c = tracked.camera_ids.index(name)
    labels = PlaneOrRegionSegmenter()(tracked.image(0, c), tracked.depth(0, c), tracked.Ks[0, c])
    return FirstMask(labels.astype(np.int32), name, "segment")


def placed(masks: str | Path) -> str | Path:
    """The source of a first mask, with an absolute path if it is a picture."""
    return masks.expanduser().resolve() if isinstance(masks, Path) else masks


def without_own_objects(recording: Recording) -> Recording:
    """The recording without its own masks, ground truth and label names: a picture defines the objects."""
    tracked, judged = (
        replace(sequence, load_mask=None, truth=None, label_names={})
        for sequence in (recording.tracked, recording.judged)
    )
    return replace(recording, tracked=tracked, judged=judged)


def _from_picture(tracked: Sequence, camera: int | None, path: Path, scale: float) -> FirstMask:
    """The first mask from a user's picture of labels, of the size of the tracked or original pictures."""
    if not (path.is_file() and is_picture(path)):
        what = f"the folder {path}" if path.is_dir() else f"{'' if path.exists() else 'no '}{path}"
        raise ValueError(f"--masks: expected auto, files, segment or a picture of labels (PNG), found {what}")
    name = tracked.camera_ids[0] if camera is None else camera
    c = tracked.camera_ids.index(name)
    depth = tracked.depth(0, c)
    if depth is None or not np.any(depth > 0):
        raise ValueError(
            f"--masks {path}: expected depth of camera {name}, to know where the objects are; "
            f"{tracked.where('depth', 0, c)} has none"
        )
    width, height = picture_size(path)
    labels = read_mask(path, width, height)
    sizes = {(tracked.width, tracked.height), (round(tracked.width / scale), round(tracked.height / scale))}
    if not any(abs(width - w) <= 1 and abs(height - h) <= 1 for w, h in sizes):
        size = " or ".join(f"{w}x{h}" for w, h in sorted(sizes))
        expected = f"{size} pixels, as the pictures of camera {name}"
        raise DataError(path, expected, f"{width}x{height}", "Give labels of its first picture.")
    _check_values(path, labels)
    labels = cv2.resize(labels, (tracked.width, tracked.height), interpolation=cv2.INTER_NEAREST_EXACT)
    return FirstMask(labels, name, PICTURE)


def _check_values(path: Path, labels: np.ndarray) -> None:
    """Raises DataError if nothing is an object, or if values are shades rather than labels."""
    values, counts = np.unique(labels[labels != 0], return_counts=True)
    if len(values) == 0:
        raise DataError(path, "at least one object", "background only", "Give each object a value above 0.")
    if (specks := counts < _LEAST_PIXELS).sum() > len(values) / 2 or len(values) > _MOST_OBJECTS:
        found = f"{len(values)} values, {specks.sum()} of them in fewer than {_LEAST_PIXELS} pixels"
        advice = "Paint with a brush without soft edges, and save a PNG: JPEG changes values."
        raise DataError(path, "one value for each object, and 0", found, advice)


def _check_not_empty(labels: np.ndarray, tracked: Sequence, c: int) -> None:
    """Raises DataError if a first mask is all background, naming a camera whose mask is not."""
    if labels.any():
        return
    masks = {name: tracked.mask(0, i) for i, name in enumerate(tracked.camera_ids)}
    better = [name for name, mask in masks.items() if mask is not None and mask.any()]
    advice = f"Use --mask-camera {better[0]}" if better else "Choose other --frames"
    what = tracked.where("mask", 0, c)
    raise DataError(what, "at least one object", "background only", f"{advice}, or --masks segment.")


def label_names(recording: Recording, source: str) -> dict[int, str]:
    """The name of each mask value that has one; only the recording's own do. They are distinct,
    because scores and queries go by name."""
    own = recording.tracked.names_of_labels if source in OWN_MASKS else {}
    return distinct_names(own, ("background", "unlabelled"))


def warn_of_missing(recording: Recording, mask: FirstMask, scene_ids: tuple[int, ...], notes: Notes) -> None:
    """Warn about objects that will not be tracked: true objects without a label in the mask, and labels
    without Gaussians.

    Args:
        recording: the recording, with or without ground truth.
        mask: the first mask.
        scene_ids: labels that the scene has.
        notes: collects the warnings.
    """
    if mask.labels is None:
        return
    names, there = label_names(recording, mask.source), set(np.unique(mask.labels).tolist())
    if mask.source == "files":
        for value in sorted(recording.tracked.known_objects.keys() - there - {0}):
            notes.warn(
                f"{names[value]} (label {value}) has no pixel in the first mask of camera {mask.camera}: "
                "it is not tracked; another --mask-camera may see it"
            )
    for value in sorted(there - set(scene_ids) - {0}):
        pixels = int((mask.labels == value).sum())
        notes.warn(
            f"label {value} has {pixels} pixels in the first mask but none with depth: it is not tracked"
        )
