"""A video, or a folder of its frames, from one static camera: no poses and no depth.

CLIP.mp4          or images/NAME.png in a folder, or pictures in the folder itself, in order of their names
masks/NAME.png    the tool in white, or in black, one per frame, optional; or gt_masks/
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gsjax.data.errors import DataError, DataWarning
from gsjax.data.files import read_image
from gsjax.data.frame_folders import (
    DEFAULT_RATE_HZ,
    check_one_size,
    frame_numbers,
    pictures,
    pictures_beside,
    warn_about_single_frame,
)
from gsjax.data.lens import intrinsics_matrix
from gsjax.data.masks import read_shades
from gsjax.data.sequence import Sequence
from gsjax.data.tool_masks import LABEL_NAMES, Tool, check_tool, find_masks, tool_labels
from gsjax.data.video import Video, describe_video
from gsjax.geometry.cameras import intrinsics

FIELD_OF_VIEW_DEGREES = 60.0
"""Horizontal field of view assumed for an uncalibrated camera: about that of a da Vinci robot's endoscope."""

SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
"""File extensions of videos."""


def read_clip(
    path: str | Path,
    *,
    K: Float[np.ndarray, "3 3"] | tuple[float, float, float, float] | None = None,
    images: str = "images",
    masks: str | None = None,
    tool: Tool = "white",
) -> Sequence:
    """The frames of one static camera, 0, at the origin. Times are those stored in the video for each frame;
    frames of a folder are 1/30 s apart.

    Without `K`, a horizontal field of view of 60 degrees and a centred principal point are assumed.

    Args:
        path: the video, or the folder of the frames.
        K: intrinsics, or (fx, fy, cx, cy), in pixels, pixel centres at +0.5.
        images: name of the frames' folder in it; if there is none, the frames lie in the folder itself.
        masks: name of the mask folder, in the folder or beside the video; None: masks/ or gt_masks/ of a
            folder, and no masks for a video.
        tool: colour of the tool in masks: "white" or "black".

    Raises:
        DataError: there are no frames, or they differ in size; the file is not a video; the numbers of masks
            and frames differ; the tool covers everything in all masks; there is depth, which needs poses.
        ValueError: an option is invalid.

    Warns with DataWarning if frames of the video cannot be decoded, `K` is not given, masks look inverted, or
    there is only one frame.
    """
    source = Path(path)
    frames = _folder_frames(source, images) if source.is_dir() else _video_frames(source)
    width, height, count = frames.width, frames.height, len(frames.times)
    home = source if source.is_dir() else source.parent
    folder = home / masks if masks else find_masks(source)
    files = pictures_beside(folder, count, source.name) if folder else []

    def load_mask(t: int) -> np.ndarray:
        return tool_labels(read_shades(files[t], width, height), tool)

    if files:
        check_tool(load_mask, count, tool, files[0].parent)
    if K is None:
        assumed = f"assuming a horizontal field of view of {FIELD_OF_VIEW_DEGREES:g} degrees"
        message = f"{source}: no intrinsics: {assumed}; give K (--read.K), fx fy cx cy in pixels"
        warnings.warn(message, DataWarning, stacklevel=2)
        K = intrinsics(0.5 * width / np.tan(np.deg2rad(0.5 * FIELD_OF_VIEW_DEGREES)), width, height)
    return Sequence(
        name=source.resolve().stem if source.is_file() else source.resolve().name,
        camera_ids=(0,),
        width=width,
        height=height,
        times=frames.times,
        frame_ids=frames.numbers,
        Ks=np.broadcast_to(intrinsics_matrix(K), (count, 1, 3, 3)),
        viewmats=np.broadcast_to(np.eye(4), (count, 1, 4, 4)),
        load_image=lambda t, c: frames.load(t),
        load_mask=(lambda t, c: load_mask(t)) if files else None,
        label_names=LABEL_NAMES if files else {},
        locate=lambda kind, t, c: str(files[t]) if kind == "mask" and files else frames.where(t),
    )


def is_clip(root: Path, images: str = "images", masks: str | None = None) -> bool:
    """Whether a path is a video, or a folder of frames with masks.

    Args:
        root: the file or folder.
        images: name of the frames' folder in it.
        masks: name of the mask folder, if the user gave one.
    """
    if root.suffix.lower() in SUFFIXES and root.is_file():
        return True
    return (find_masks(root) is not None or masks is not None) and bool(_frames_in(root, images))


class _Frames(NamedTuple):
    width: int
    height: int
    times: Float[np.ndarray, "t"]
    numbers: tuple[int, ...]
    load: Callable[[int], np.ndarray]
    where: Callable[[int], str]


def _video_frames(path: Path) -> _Frames:
    file = describe_video(path)
    video = Video(path, file.width, file.height, file.frames, file)
    numbers = tuple(range(file.frames))
    return _Frames(file.width, file.height, file.times, numbers, video.frame, lambda t: f"{path}, frame {t}")


def _folder_frames(root: Path, images: str) -> _Frames:
    frames = _frames_in(root, images)
    if not frames:
        raise DataError(root, f"frames, in {images}/ or directly in it", "none", "Give their folder.")
    if (root / "depth").is_dir():
        advice = "Add it (with equal rows for a static camera), or remove depth/."
        raise DataError(root, "poses_bounds.npy beside depth/", "no such file", advice)
    width, height = check_one_size(frames)
    warn_about_single_frame(frames)
    times = np.arange(len(frames)) / DEFAULT_RATE_HZ
    return _Frames(
        width,
        height,
        times,
        frame_numbers(frames),
        lambda t: read_image(frames[t], width, height),
        lambda t: str(frames[t]),
    )


def _frames_in(root: Path, images: str) -> list[Path]:
    return pictures(root / images) or pictures(root)
