"""The depth that `gsjax deform` starts with: the data's own, from stereo matching of two cameras, or none."""

from dataclasses import replace
from typing import Literal

import numpy as np

from gsjax.data import Sequence
from gsjax.engine.messages import Notes
from gsjax.geometry.extent import extent_of
from gsjax.methods.deform import goes_around
from gsjax.perception.stereo import stereo_depth

Depth = Literal["auto", "data", "stereo", "hull", "plane"]
DepthSource = Literal["data", "stereo", "hull", "plane"]
METRIC: tuple[DepthSource, ...] = ("data", "stereo")
"""Sources with which lengths are in the unit of the data, metres."""


def shows_one_object(sequence: Sequence, source: DepthSource) -> bool:
    """Whether a camera goes around an object with nothing behind it, the case for `PRESETS["around"]`.

    Args:
        sequence, source: from `with_depth`.
    """
    return source == "hull" and sequence.background is not None


def with_depth(sequence: Sequence, wanted: Depth, plane: float, notes: Notes) -> tuple[Sequence, DepthSource]:
    """The recording with depth of camera 0, and the source of the depth: the recording's own, else stereo
    matching with camera 1, else none; the scene then starts within its visual hull if the camera goes around
    it, else on a plane. With depth, lengths are in metres if the data's are.

    Args:
        sequence: the recording; camera 0 is the training camera.
        wanted: the source; "auto" takes the first that exists.
        plane: distance of the plane from the first camera, in the unit of the poses.
        notes: receives the source.

    Raises:
        ValueError: there is no depth of the wanted kind.
    """
    two = sequence.num_cameras > 1
    frames = range(sequence.num_frames) if wanted in ("auto", "data") else ()
    own = any(sequence.depth(t, 0) is not None for t in frames)
    if wanted == "data" and not own:
        raise ValueError(
            f"--depth data: {sequence.name} has none of camera {sequence.camera_ids[0]}; leave it at auto, "
            "or put depth of a network beside the frames, as EndoNeRF has it (docs/data.md)"
        )
    if wanted == "stereo" and not two:
        raise ValueError(
            f"--depth stereo: {sequence.name} has one camera, {sequence.camera_ids[0]}; expected a second "
            "one to its right, as EndoNeRF's folders have in right/ (docs/data.md)"
        )
    if wanted == "hull" and extent_of(sequence.viewmats[:, 0]).is_point:
        raise ValueError(
            f"--depth hull: {sequence.name} is seen from one place; expected a camera that goes around the "
            "scene; leave it at auto"
        )
    if own:
        return sequence, "data"
    if wanted == "stereo" or (wanted == "auto" and two):
        return _from_stereo(sequence, notes)
    if wanted == "hull" or (wanted == "auto" and goes_around(sequence.viewmats[:, 0])):
        notes.add(
            "There is no depth: the scene starts as random points within its visual hull, which is what most "
            "frames show before the background. Its depth is learned from images alone, and is not scored."
        )
        return _without_depth(sequence), "hull"
    return _from_plane(sequence, plane, notes)


def _from_stereo(sequence: Sequence, notes: Notes) -> tuple[Sequence, DepthSource]:
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


def _from_plane(sequence: Sequence, plane: float, notes: Notes) -> tuple[Sequence, DepthSource]:
    """The first camera alone, without depth; notes the distance of the plane."""
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
    return _without_depth(sequence), "plane"


def _without_depth(sequence: Sequence) -> Sequence:
    """The first camera alone, without depth and ground truth, as the scene may not be in metres."""
    alone = sequence.select(cameras=[sequence.camera_ids[0]])
    names = alone.names_of_labels  # some may come from the ground truth
    return replace(alone, load_depth=None, truth=None, label_names=names)
