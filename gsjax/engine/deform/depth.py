"""The depth that `gsjax deform` begins with: the data's, matched between two cameras, or none."""

from dataclasses import replace
from typing import Literal

import numpy as np

from gsjax.data import Sequence
from gsjax.engine.messages import Notes
from gsjax.perception.stereo import stereo_depth

Depth = Literal["auto", "data", "stereo", "plane"]
DepthSource = Literal["data", "stereo", "plane"]


def with_depth(sequence: Sequence, wanted: Depth, plane: float, notes: Notes) -> tuple[Sequence, DepthSource]:
    """The recording with depth of camera 0, and its source: the recording's own, else matched with camera 1,
    else none: the scene then begins on a plane. Lengths are metres if the data's are, except on a plane.

    Args:
        sequence: camera 0 is learned from.
        wanted: the source; "auto" takes the first of the three that exists.
        plane: distance of the plane from the first camera, in the unit of the poses.
        notes: receives the source.

    Raises:
        ValueError: there is no depth of the wanted kind.
    """
    two = sequence.num_cameras > 1
    if wanted == "data" and not sequence.has_depth:
        raise ValueError(
            f"--depth data: {sequence.name} has none; leave it at auto, or put depth of a network beside the "
            "frames, as EndoNeRF has it (docs/data.md)"
        )
    if wanted == "stereo" and not two:
        raise ValueError(
            f"--depth stereo: {sequence.name} has one camera, {sequence.camera_ids[0]}; expected a second "
            "one to its right, as EndoNeRF's folders have in right/ (docs/data.md)"
        )
    if wanted == "data" or (wanted == "auto" and sequence.has_depth):
        return sequence, "data"
    if wanted == "stereo" or (wanted == "auto" and two):
        return _of_two_eyes(sequence, notes)
    return _of_a_plane(sequence, plane, notes)


def _of_two_eyes(sequence: Sequence, notes: Notes) -> tuple[Sequence, DepthSource]:
    def load(t: int, c: int) -> np.ndarray | None:
        if c != 0:
            return None
        pictures = (sequence.image(t, eye) for eye in (0, 1))
        return stereo_depth(*pictures, sequence.viewmats[t, :2], sequence.Ks[t, :2])

    try:
        first = load(0, 0)
    except ValueError as error:
        raise ValueError(
            f"{sequence.name}: cameras {sequence.camera_ids[0]} and {sequence.camera_ids[1]} cannot be "
            f"matched: {error}; --depth plane starts without them"
        ) from error
    assert first is not None
    covered = float((first > 0).mean())
    if covered < 0.2:
        notes.warn(
            f"{sequence.name}: matching both eyes found depth in {covered:.0%} of the first frame's pixels; "
            "check the poses, and that images were taken at the same time; --depth plane starts without it"
        )
    notes.add(
        f"Depth is matched between cameras {sequence.camera_ids[0]} and {sequence.camera_ids[1]} (in "
        f"{covered:.0%} of the first frame's pixels): depth errors are relative to the matched depth, and "
        "the other camera is not held out in the training frames."
    )
    return replace(sequence, load_depth=load), "stereo"


def _of_a_plane(sequence: Sequence, plane: float, notes: Notes) -> tuple[Sequence, DepthSource]:
    """The first camera alone, without what is known in metres, because the scene has another unit."""
    notes.add(
        f"There is no depth: the scene starts on a plane {plane:g} in front of the first camera. Its depth "
        "has no metric unit, is learned from images alone, and is not scored."
    )
    rotations, shifts = sequence.viewmats[:, 0, :3, :3], sequence.viewmats[:, 0, :3, 3]
    centers = -np.einsum("tji,tj->ti", rotations, shifts)
    moved = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if moved == 0:
        notes.add(
            "The camera has one pose in all frames; if it moved, its motion appears as motion of the scene. "
            "`gsjax poses` finds the poses of a video whose scene is mostly static."
        )
    else:
        notes.warn(
            f"{sequence.name}: the camera moves by {moved:.3g}, and the distance of the scene is not known; "
            f"pass it, roughly, with --deform.plane-depth (now {plane:g}), in the unit of the poses"
        )
    alone = sequence.select(cameras=[sequence.camera_ids[0]])
    names = alone.names_of_labels  # some of which may be truth's
    return replace(alone, load_depth=None, truth=None, label_names=names), "plane"
